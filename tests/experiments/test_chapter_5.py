"""The parts of the experiments of chapter 5, one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxctrl as jc
from jaxctrl.experiments import (
    Result,
    _chapter_5 as shared,
    _random_laws as random_laws,
    _recursions as recursions,
    fig_5_7,
    fig_5_8,
    named,
    prediction,
)


def test_a_cosine_is_found_again_and_two_lobes_are_not_explained():
    angles = shared.angles(16)
    means = np.stack([0.2 + 0.1 * np.cos(angles - 1.0), np.cos(2 * angles)], axis=1)
    towards, explained = fig_5_7._tuning(angles, means[None])
    assert_allclose(towards[0, 0], 1.0)
    assert_allclose(explained[0], [1.0, 0.0], atol=1e-12)


def test_directions_are_apart_by_at_most_half_a_turn():
    assert fig_5_7._apart(350.0, 10.0) == 20.0
    assert fig_5_7._apart(0.0, 180.0) == 180.0
    assert fig_5_7._apart(90.0, 315.0) == 135.0


def costs(difference, error):
    """Make a result of two directions with given differences of costs, A - C and C - B."""
    both, count = ("controller", "direction"), 2
    values = {
        "cost": (both, np.ones((3, count)), named("cost", "1")),
        "end_cov": ((*both, "axis", "other"), np.ones((3, count, 2, 2)), named("cov", "m^2")),
        "difference": (("pair", "direction"), np.array(difference), named("difference", "1")),
        "difference_error": (("pair", "direction"), np.array(error), named("error", "1")),
    }
    coords = shared.Reaches(directions=count, num_steps=2).coordinates("other") | {
        "controller": ("controller", ["A", "B", "C"], {"long_name": "controller"}),
        "pair": ("pair", ["A - C", "C - B"], {"long_name": "pair"}),
    }
    return Result(xarray.Dataset(values, coords=coords), fig_5_8.Config())


def test_orders_of_costs_are_judged_by_intervals():
    judged = fig_5_8.claims(costs([[3.0, 2.0], [3.0, 0.1]], np.ones((2, 2))))
    assert [claim.holds for claim in judged] == [True, True, True, False]
    assert "too few" in judged[3].note and "nearest at 180 degrees" in judged[3].measured
    judged = fig_5_8.claims(costs([[3.0, -3.0], [-3.0, -4.0]], np.ones((2, 2))))
    assert [claim.holds for claim in judged] == [False] * 4
    assert "too few" in judged[0].note
    assert all("other way round" in claim.note for claim in judged[1:])


def test_two_peaks_are_no_bell():
    time = np.linspace(0, 1, 101)
    speed = np.stack([np.sin(np.pi * time), np.sin(2 * np.pi * time) ** 2])
    data = xarray.Dataset({"speed": (("direction", "time"), speed)}, coords={"time": time})
    claim = shared.bells(data, "nowhere", "two bumps")
    assert not claim.holds and claim.note == "two bumps"
    assert "1 of 2" in claim.measured
    assert shared.bells(data.isel(direction=[0]), "nowhere").holds


def test_ellipses_have_the_axes_of_the_covariance():
    figure = jc.plot.panels()[0]
    ax = figure.axes[0]
    shared.draw_ellipse(ax, np.zeros(2), np.diag([1e-6, 4e-6]), 10.0)
    (ellipse,) = ax.patches
    half = 1000 * np.sqrt(-2 * np.log(0.05)) * np.array([2e-3, 1e-3])  # [cm], ten times too large
    assert_allclose([ellipse.width, ellipse.height], 2 * half)
    assert_allclose(abs(ellipse.angle), 90.0)
    assert_allclose(shared.spread(np.diag([1e-6, 4e-6])), np.sqrt(5e-6))


def planned(cost, ok=None, miss=0.0, laws=50):
    """Make a result of two amplitudes, one direction: costs of the second one's laws."""
    lanes, shape = ("amplitude", "direction", "law"), (2, 1, laws)
    costs, converged = np.ones(shape), np.ones(shape, bool)
    costs[1, 0, : len(cost)] = cost
    converged[1, 0, : len(cost)] = True if ok is None else ok
    hand = np.zeros((*shape, 3, 2))
    hand[1, 0, 0, -1, 0] = miss
    words = named("made up", "1")
    values = {
        "cost": (lanes, costs, words),
        "ok": (lanes, converged, words),
        "iterations": (lanes, np.ones(shape, int), words),
        "first_strays": (("amplitude", "law"), np.zeros((2, laws), bool), words),
        "strays": (lanes, np.zeros(shape, bool), words),
        "hand": ((*lanes, "time", "axis"), hand, words),
        "target": (("direction", "axis"), np.zeros((1, 2)), words),
    }
    coords = random_laws.Settings(directions=1, num_steps=2).coordinates()
    coords["amplitude"] = ("amplitude", [0.1, 0.3], words)
    return Result(xarray.Dataset(values, coords), random_laws.Settings())


def test_random_laws_are_judged_by_the_interval_of_those_that_find_the_best():
    claims = random_laws.claims(planned([1.2] * 10), "nowhere")
    assert [claim.holds for claim in claims] == [True, True]
    assert "0.80 by direction, the least in 0.67 to 0.89" in claims[0].measured
    assert not random_laws.claims(planned([1.2] * 22), "nowhere")[0].holds  # 28 of 50: too near
    assert random_laws.claims(planned([1.04] * 22), "nowhere")[0].holds
    # What has not converged is no best, however cheap.
    assert random_laws.claims(planned([0.1] * 5, ok=False), "nowhere")[0].holds


def test_ends_are_judged_over_all_laws():
    assert random_laws.claims(planned([], miss=0.009), "nowhere")[1].holds
    claim = random_laws.claims(planned([1.2], miss=0.011), "nowhere")[1]
    assert not claim.holds and claim.note and "0.980 of all are nearer" in claim.measured


def test_laws_of_a_problem_stand_in_a_row():
    problems = jc.tasks.centre_out(jc.plants.TorqueArm(), jnp.array([0.8, 1.6, 0, 0]), n=3)
    one = jax.tree.map(lambda leaf: leaf[0], problems)
    settings = random_laws.Settings(laws=2)
    laws = random_laws.draw(jc.plants.TorqueArm(), one, 0.3, settings)
    tasks, starts = random_laws.all_pairs(problems, laws)
    assert len(tasks.dt) == len(starts.us) == 6
    assert_allclose(starts.us[::2], np.stack([laws.us[0]] * 3))
    assert not np.allclose(laws.K[0], laws.K[1])
    for leaf, repeated in zip(jax.tree.leaves(problems), jax.tree.leaves(tasks), strict=True):
        assert_allclose(repeated, np.repeat(leaf, 2, axis=0))


@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_recursion_with_the_true_hessian_promises_what_its_law_gains(damping):
    reaches, arm = shared.Reaches(num_steps=10), jc.plants.TorqueArm()
    problem = jax.tree.map(lambda leaf: leaf[1], reaches.problems(arm))
    us = 0.1 * jax.random.normal(jax.random.key(0), (10, 2))
    xs = problem.rollout(arm.at_rest(*shared.START), us)
    model, d = jc.expand(problem, xs, us, noise=True), jnp.full((10, 2), damping)
    law, held = recursions.TrueHessianILQG().law(model, d, None, 0 * us, None)
    fixed = jc.linear.lqr(model, d)
    assert bool(law.ok) and int(law.failed) == int(law.nonfinite) == -1 and not held.any()
    gains = jc.linear.evaluate(model, law.k, law.K).v - jc.linear.evaluate(model, 0 * us, law.K).v
    assert_allclose(law.linear + law.quadratic, gains, rtol=1e-9)
    if damping == 0:  # one and the same
        for name in ("k", "K", "gradient", "curvature", "linear", "quadratic"):
            assert_allclose(getattr(law, name), getattr(fixed, name), rtol=1e-6, atol=1e-12)
    else:
        assert np.abs(law.k / fixed.k - 1).max() > 0.1
        assert_allclose(law.k[-1], fixed.k[-1])  # the same step, before any recursion


def recursed(ratio, lost=0):
    """Make data of two directions and twenty laws, damped ones with a ratio of iterations."""
    lanes, shape = ("hessian", "damping", "direction", "amplitude", "law"), (2, 2, 2, 2, 20)
    counts, expected = np.full(shape, 10.0), np.ones(shape)
    counts[1, 1] = 10 * ratio * np.exp(0.1 * np.random.default_rng(0).standard_normal(20))
    expected[1, 1, ..., :lost] = 2.0
    values = {"iterations": counts, "expected": expected, "converged": expected > 0}
    return xarray.Dataset({name: (lanes, each) for name, each in values.items()})


def test_recursions_are_judged_by_intervals_over_laws():
    judged = recursions.claims(recursed(0.8))
    assert [claim.holds for claim in judged] == [True, False, True]
    assert "1.000 (1.000 to 1.000)" in judged[1].measured
    assert not recursions.claims(recursed(1.0))[0].holds
    lost = recursions.claims(recursed(0.8, lost=4))
    assert lost[0].holds and not lost[2].holds and "-0.200" in lost[2].measured


def test_predictions_are_judged_by_how_surely_trials_are_off():
    dims, ones = ("case", "intensity", "direction"), np.ones((3, 2, 1))
    cost, found = ones.copy(), ones.copy()
    cost[1] = [[1.04], [1.2]]
    cost[2] = [[1.06], [1.0]]
    found[0, 1] = 0.8
    error = 0.01 * ones
    values = {"expected": ones, "cost": cost, "error": error, "predicted": ones, "found": found}
    data = xarray.Dataset(
        {name: (dims, value, named(name, "1")) for name, value in values.items()},
        coords={
            "case": ("case", list(prediction.CASES), {"long_name": "arm"}),
            "intensity": ("intensity", [0.01, 0.02], named("motor noise", "s^(1/2)")),
        },
    )
    judged = prediction.claims(Result(data, prediction.Config(trials=1000)))
    # In the last row 6 +- 1 % might be 5 %.
    assert [claim.holds for claim in judged] == [True, False, False, True, True, True]
    assert "leaves 5 % at 0.02" in judged[2].note and "clipped" in judged[2].note
