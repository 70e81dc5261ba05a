"""What the comparisons of chapter 4 are built of, and how their claims are judged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jaxctrl as jc
from jaxctrl.experiments import (
    _chapter_4 as chapter,
    _table_4_1_claims as judging,
    _table_4_1_runs as runs,
    table_4_1,
)
from jaxctrl.experiments._differences import DifferencedDDP, differences, evaluations


def test_random_controls_have_the_distribution_that_is_stated():
    torque = chapter.arm_case("torque", 50)
    us = chapter.random_controls(torque, 2000, 3.0, seed=1)
    assert us.shape == (2000, 50, 2)
    # Neighbours in time are alike, so that a column counts for few: the error is by starts alone.
    assert us.std(axis=0) == pytest.approx(3.0, abs=5 * 3.0 / np.sqrt(2 * 2000))
    assert np.abs(us.mean(axis=0)).max() < 5 * 3.0 / np.sqrt(2000)
    muscle = chapter.arm_case("muscle", 50)
    us = chapter.random_controls(muscle, 2000, 0.3, seed=1)
    assert us.min() >= 0 and us.max() <= 0.3
    quarters = np.quantile(us, (0.25, 0.5, 0.75), axis=0)
    assert np.abs(quarters - np.array([0.075, 0.15, 0.225])[:, None, None]).max() < 0.02
    # After 25 ms, one standard deviation of the filter, exp(-1/4) is left.
    z = chapter.random_controls(torque, 2000, 1.0, seed=2)
    lag = round(chapter.SMOOTHING / 0.01)
    half = (
        0.5 * (z[:, lag:] * z[:, :-lag]).mean() + 0.5 * (z[:, lag + 1 :] * z[:, : -lag - 1]).mean()
    )
    wanted = np.mean([np.exp(-((0.01 * k / chapter.SMOOTHING) ** 2) / 4) for k in (lag, lag + 1)])
    assert half == pytest.approx(wanted, abs=0.03)


def test_the_timed_loop_passes_through_the_iterates_of_solve():
    case = chapter.arm_case("torque", 30)
    us = case.problem.nominal_controls
    solution = jc.solve(case.problem, jc.ILQR(), case.x0)
    repeated = chapter.timed(case, jc.ILQR())
    for i in (0, 2, int(solution.num_steps), 100):
        cost, count = chapter.iterate(case, jc.ILQR(), us, jnp.asarray(i), None)
        at = min(i, int(solution.num_steps))
        assert int(count) == at
        assert float(cost) == pytest.approx(float(solution.history.cost[at]), rel=1e-12)
        for times in (1, 3):
            again, at_iterate = repeated(us, i, times)
            assert float(again) == float(cost) and int(at_iterate) == at


def test_the_first_iterate_within_a_tolerance_is_found():
    costs = np.array([9.0, 2.0, 1.05, 1.0005, 1.0, np.nan])
    found = chapter.first_within(costs, 1.0, (1e-1, 1e-3, 1e-4, -1e-3))
    assert found[:3] == [2.0, 3.0, 4.0] and np.isnan(found[3])


def made_up(seconds, cost, best=1.0):
    """Return a result as `table_4_1.run` does, with the same figures for all problems."""
    names, problems = list(runs.METHODS), list(table_4_1.PROBLEMS)
    near = np.array(runs.NEAR)

    def every(values):
        return np.stack(
            [np.asarray(values, dtype=object if isinstance(values[0], str) else float)]
            * len(problems)
        )

    # The textbook's DDP, here, is as DDP.
    seconds, cost = [[*v[:2], v[1], *v[2:]] for v in (seconds, cost)]
    seconds = np.asarray(seconds, float)
    iterations = np.where(np.isnan(seconds), np.nan, 7.0)
    iterations[-1] = np.nan
    return xarray.Dataset(
        {
            "cost": (("problem", "solver"), every(cost)),
            "status": (("problem", "solver"), np.full((6, 6), "CONVERGED_COST")),
            "steps": (("problem", "solver"), np.full((6, 6), 9)),
            "accepted": (("problem", "solver"), np.full((6, 6), 8)),
            "evaluations": (("problem", "order"), np.tile([32, 513], (6, 1))),
            "seconds": (("problem", "solver", "near"), np.stack([seconds] * 6)),
            "wall": (("problem", "solver", "near"), np.stack([seconds] * 6)),
            "spread": (("problem", "solver", "near"), 0.1 * np.stack([seconds] * 6)),
            "iterations": (("problem", "solver", "near"), np.stack([iterations] * 6)),
            "first": (("problem", "solver"), np.ones((6, 6))),
            "best": ("problem", np.full(6, best)),
            "undamped": (("problem", "measure"), np.tile([1e-9, 9.0], (6, 1))),
        },
        coords={"problem": problems, "solver": names, "near": near},
    )


def judged(data):
    found = judging.claims(data, table_4_1.THESIS, table_4_1.PROBLEMS)
    return {claim.statement: claim for claim in found}


NEVER = [np.nan] * 3
TENFOLD = "ILQR is more than 10 times faster than the nearest rival: muscle arm"


def test_claims_hold_when_ilqr_is_far_ahead():
    slow = [[0.02] * 3, [0.03] * 3, [0.02] * 3]
    data = made_up([[0.001] * 3, *slow, NEVER], [1.0, 1.1, 1.1, 1.1, 2.0])
    claims = judged(data)
    assert claims["ILQR is the fastest: muscle arm"].holds
    assert "BVP never (+1.0e+00" in claims["ILQR is the fastest: muscle arm"].measured
    assert claims[TENFOLD].holds and "20x" in claims[TENFOLD].measured
    assert claims["ILQR finds a better solution than the others: pendulum"].holds
    assert claims["ILQR needs the fewest iterations: torque arm"].holds
    damping = claims["ILQR needs Levenberg-Marquardt damping for stable iterations"]
    assert not damping.holds


def test_claims_fail_when_a_rival_is_ahead_or_ilqr_never_arrives():
    data = made_up([[0.003] * 3, [0.001] * 3, [0.1] * 3, NEVER, NEVER], [1.0, 0.99, 1, 1, 1], 0.99)
    claims = judged(data)
    assert not claims["ILQR is the fastest: torque arm"].holds
    assert not claims[TENFOLD].holds
    assert not claims["ILQR finds a better solution than the others: pendulum"].holds
    data = made_up([NEVER, [0.001] * 3, NEVER, NEVER, NEVER], [2.0, 1, 3, 3, 3])
    claims = judged(data)
    assert not claims["ILQR is the fastest: torque arm"].holds
    assert "never near" in claims["ILQR is the fastest: torque arm"].measured
    assert not claims[TENFOLD].holds


def test_a_tie_is_no_lead():
    # Within the spreads, or within a fifth.
    for rival, spread, holds in (
        (0.00115, 0.01, False),
        (0.00125, 0.01, True),
        (0.0019, 0.4, False),
    ):
        data = made_up([[0.001] * 3, [rival] * 3, NEVER, NEVER, NEVER], [1.0] * 5)
        data["spread"] = spread * data.seconds
        claim = judged(data)["ILQR is the fastest: torque arm"]
        assert (
            claim.holds == holds
            and ("No lead, within the spreads or a fifth: DDP" in claim.note) != holds
        )


def test_claims_take_the_tightest_tolerance_that_ilqr_reaches():
    fast = [0.001, 0.002, np.nan]
    claims = judged(
        made_up([fast, [0.01, 0.001, 0.001], NEVER, NEVER, NEVER], [1.0005, 1, 1, 1, 1])
    )
    claim = claims["ILQR is the fastest: muscle arm"]
    assert "within 0.01" in claim.measured and not claim.holds and "no nearer" in claim.note


def test_the_textbooks_ddp_is_judged_by_its_iterations_and_evaluations():
    data = made_up([[0.001] * 3, [0.02] * 3, [0.03] * 3, [0.02] * 3, NEVER], [1.0] * 5)
    slower = "DDP as in the textbook needs more iterations than ILQR: muscle arm"
    cost = "Hessians by differences cost as much as DDP's iterations in the thesis: muscle arm"
    claims = judged(data)
    assert not claims[slower].holds and "7 and 7 to 0.0001" in claims[slower].measured
    assert claims[cost].holds and "beside 32: 16.0 times" in claims[cost].measured
    data.iterations.loc[{"solver": "textbook DDP", "near": 1e-4}] = 29.0
    assert judged(data)[slower].holds
    named = data.solver.values.astype(object)
    named[1] = judging.BY_DIFFERENCES  # whatever the place
    assert (
        "20 times ILQR's time to 0.0001" in judged(data.assign_coords(solver=named))[cost].measured
    )


def test_differences_give_the_exact_hessians_with_the_stated_number_of_evaluations():
    case, seen = chapter.arm_case("torque", 10), []

    def f(z):
        return jnp.sin(z[0] * z[1]) + z[2] ** 3 * z[0]

    def counted(z):
        jax.debug.callback(lambda z: seen.append(z), z)
        return f(z)

    z = jnp.array([0.3, -1.2, 2.0])
    np.testing.assert_allclose(differences(counted, z), jax.hessian(f)(z), atol=1e-5)
    jax.effects_barrier()
    assert len(seen) == 2 * 3**2 + 1
    n = case.problem.plant.nx + case.problem.plant.nu
    assert evaluations(case.problem) == (2 * n, 2 * n**2 + 1) == (12, 73)
    us = 0.1 * jnp.ones((10, 2))
    xs = case.problem.rollout(case.x0, us)
    exact = jc.expand(case.problem, xs, us, second_order=True)
    got = DifferencedDDP().expand(case.problem, xs, us, False)
    for name in ("fx", "lxx", "lux", "luu", "vxx"):
        np.testing.assert_allclose(getattr(got, name), getattr(exact, name), atol=1e-6)


def test_what_lies_outside_a_window_is_named():
    path = np.array([[1.5, 1.5], [1.2, 1.7], [0.9, 1.25]])
    assert chapter.outside(path, chapter.WINDOW) == "shoulder to 0.90, elbow to 1.25 and 1.70"
    assert chapter.outside(path[:1], chapter.WINDOW) == ""


def test_the_table_has_the_thesiss_columns_beside_ours():
    data = made_up([[0.001] * 3, [0.02] * 3, [0.03] * 3, [0.02] * 3, NEVER], [1.0] * 5)
    head, *rows = judging.table(data, table_4_1.THESIS, table_4_1.PROBLEMS)
    assert len(rows) == 36 and {len(row) for row in rows} == {len(head)}
    muscle = {row[1]: dict(zip(head, row, strict=True)) for row in rows if row[0] == "muscle arm"}
    assert muscle["BVP"]["thesis s"] == "> 400" and muscle["BVP"]["/ ILQR"] == "–"
    assert muscle["DDP"]["thesis / ILQR"] == "–" and muscle["DDP"]["/ ILQR"] == "20.00"
    assert muscle["textbook DDP"]["thesis / ILQR"] == "21.8"
    assert muscle["L-BFGS"]["thesis s"] == "–"
