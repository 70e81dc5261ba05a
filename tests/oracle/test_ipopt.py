"""IPOPT, on CasADi's own version of a problem, finds nothing better than jaxctrl does."""

import numpy as np
import pytest

pytest.importorskip("casadi")

from comparison import Comparison, compare
from oracle_cases import QUICK, SLOW, torque_posture

TOLERANCE = 1e-6
"""The relative improvement of the cost that is allowed to IPOPT."""


def check(result: Comparison) -> None:
    """Compare roll-outs, costs and optima."""
    solution = result.solution
    assert bool(solution.status.ok), solution.status.message
    size = np.maximum(np.abs(result.xs).max(), 1.0)
    assert np.abs(result.xs - np.asarray(solution.xs)).max() <= 1e-10 * size
    assert abs(result.cost / float(solution.cost) - 1) <= 1e-10
    assert result.outcome.status == "Solve_Succeeded"
    assert abs(result.improvement) <= TOLERANCE


@pytest.mark.parametrize("name", QUICK)
def test_ipopt_cannot_improve(name):
    check(compare(QUICK[name]()))


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_ipopt_cannot_improve_slow(name):
    check(compare(SLOW[name]()))


@pytest.mark.parametrize("bounds", [None, (-1.3, 1.3)], ids=["free", "bounded"])
def test_ipopt_comes_back_from_spoilt_controls(bounds):
    case = torque_posture(bounds)
    noise = np.random.default_rng(0).normal(size=(50, 2))
    spoilt = np.clip(np.asarray(compare(case).solution.us) + 0.1 * noise, *(bounds or (-9, 9)))
    result = compare(case, spoilt)
    assert result.outcome.status == "Solve_Succeeded"
    assert abs(result.improvement) <= TOLERANCE
