"""Every experiment of the registry, in its quick configuration."""

import dataclasses
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jaxctrl import experiments
from jaxctrl.experiments import Claim, Result

# Claims that do not hold, in so small a run: whichever else fails, or holds of these, is news.
FAILING = {
    "fig-3.6": {
        "The speed has two peaks under minimum torque change",
        "The speed's valley is where the path bends most, under minimum energy",
    },
    "fig-3.8": {
        "Near the straight line the speed has one peak, far from it two (torque change)",
        "One peak up to some distance of the via-point, two beyond (torque change)",
        "The valley deepens with the via-point's distance (torque change)",
        "Near the straight line the speed has one peak, far from it two (energy)",
    },
    "fig-3.10": {
        "The via-points are passed (torque change)",
        "The later the passing, the later the speed's valley (torque change)",
        "The via-points are passed (energy)",
    },
    "fig-4.1": {
        "The joints of the torque-driven arm stay within the figure's axes, with a stopping term",
        "The joints of the torque-driven arm stay within the figure's axes, (4.20) as printed",
    },
    "fig-4.4": {
        "The torque arm's converged paths stay within the figure's axes, with a stopping term",
        "The torque arm's converged paths stay within the figure's axes, (4.20) as printed",
    },
    "ablations-5.1": {
        "Weak noise, 0.02 s^(1/2), is an energy cost by itself: without effort ILQG converges to "
        "smooth torques",
        "Undamped at first, ILQG takes fewer iterations with the true Hessian in its recursion",
    },
    "fig-5.8": {
        "ILQR, made without noise (C) costs more than ILQG (B), in each direction",
    },
    "table-4.1": {
        "Hessians by differences cost as much as DDP's iterations in the thesis: pendulum",
        "ILQR needs Levenberg-Marquardt damping for stable iterations",
    },
    "two-thirds": {
        "The two-thirds power law holds for scribbles under least energy of six muscles, timing "
        "free",
        "The two-thirds power law holds for scribbles under least jerk, timing free",
        "Least jerk gives scribbles without inflections the exponents predicted of their shapes",
        "The exponents of optimal scribbles differ from that of smoothed noise",
    },
    "curvature-map": {
        "Curvature of minimum torque change depends on the area of the workspace",
        "Transverse reaches of minimum energy curve more than radial ones",
    },
}
# Claims about times, which may go either way on a busy machine: test_chapter_4.py judges them by
# made-up times.
TIMED = {
    "fig-4.3": {"At equal time"},
    "table-4.1": {"ILQR is the fastest"},
    "fig-5.6": {"The time of"},
}


LONG = {
    "fig-3.8", "fig-3.10", "fig-4.4", "table-4.1", "fig-5.6", "fig-5.7", "fig-5.10",
    "ablations-5.1", "prediction",
}  # fmt: skip
"""Quick runs that take long to compile all the same, most of it in code that others run, too."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in LONG else name
        for name in experiments.names()
    ],
)
def test_quick_run_converges_draws_and_claims(name):
    module = experiments.load(name)
    config = module.Config.quick()
    assert dataclasses.asdict(config) != dataclasses.asdict(module.Config())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = module.run(config)
        figure = module.figure(result)
    assert isinstance(result, Result) and result.config == config
    assert result.failure == ""
    for variable in result.data.data_vars.values():
        if variable.dtype.kind == "f" and "missing" in variable.attrs:  # it says where NaN stands
            assert np.isfinite(variable).any(), variable.name
        elif variable.dtype.kind in "biufc":
            assert np.isfinite(variable).all(), variable.name
    labelled = [a for a in figure.axes if a.axison]
    assert any(axes.get_xlabel() for axes in labelled) and any(a.get_ylabel() for a in labelled)
    plt.close(figure)
    judge(name, module.claims(result))


def judge(name, claims):
    """Check that exactly the claims fail that are known to, each with a note that says why."""
    assert claims and all(isinstance(claim, Claim) for claim in claims)
    statements = [claim.statement for claim in claims]
    assert len(set(statements)) == len(statements)
    timed = tuple(TIMED.get(name, ()))
    judged = [claim for claim in claims if not (timed and claim.statement.startswith(timed))]
    failing = {claim.statement for claim in judged if not claim.holds}
    assert failing == FAILING.get(name, set())
    for claim in claims:
        assert claim.holds or claim.note, claim.statement


def test_the_list_of_failing_claims_is_of_experiments_that_there_are():
    assert {*FAILING, *TIMED} <= set(experiments.names())
