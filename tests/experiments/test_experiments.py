"""Every experiment of the registry, in its quick configuration."""

import dataclasses
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jaxctrl import experiments
from jaxctrl.experiments._result import Claim, Result

# What compiles long: like another one, or tested in parts elsewhere.
SLOW = {
    "fig-3.4", "fig-3.6", "fig-3.8", "fig-3.10", "two-thirds", "curvature-map", "fig-4.3",
    "table-4.1",
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
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
    claims = module.claims(result)
    assert claims and all(isinstance(claim, Claim) for claim in claims)
    for claim in claims:
        assert claim.holds or claim.note, claim.statement
    plt.close(figure)
