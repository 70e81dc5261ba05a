"""Every experiment of the registry, in its quick configuration."""

import dataclasses
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jaxctrl import experiments
from jaxctrl.experiments import Claim, Result

# Claims that do not hold, in so small a run: whichever else fails, or holds of these, is news.
FAILING = {}
# Claims about times, which may go either way on a busy machine: test_chapter_4.py judges them by
# made-up times.
TIMED = {
    "fig-4.3": {"At equal time"},
    "table-4.1": {"ILQR is the fastest"},
}


@pytest.mark.parametrize("name", experiments.names())
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
    assert {claim.statement for claim in judged if not claim.holds} == FAILING.get(name, set())
    for claim in claims:
        assert claim.holds or claim.note, claim.statement


def test_the_list_of_failing_claims_is_of_experiments_that_there_are():
    assert {*FAILING, *TIMED} <= set(experiments.names())
