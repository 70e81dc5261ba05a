"""The parts of the experiments on the two-thirds power law and on curvature, one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxctrl as jc
from jaxctrl._integrate import RK4
from jaxctrl._problem import Problem
from jaxctrl.analysis import curvature, path_length
from jaxctrl.experiments import (
    _closed_paths as shapes,
    _planned,
    _shape_prediction,
    centre_out,
    chapter_3,
    curvature_map,
    fig_3_4,
)
from jaxctrl.experiments._free_timing import ClosedPath, OnPath, PathCost, StepOnPath
from jaxctrl.experiments._result import Claim
from jaxctrl.plants import FreeHand, MuscleArm, PolynomialJerk, TorqueArm
from jaxctrl.tasks import Effort


@pytest.fixture
def wave():
    return shapes.scribbles(1, 3, 300.0)[1][0]


def on_path(body, wave, turns=2.0, rate=3.0):
    path = ClosedPath(jnp.array(shapes.CENTRE), jnp.array(wave))
    return OnPath(body, path, turns=turns, rate=rate, fastest=5 * rate)


def test_path_and_slope_are_those_of_the_series(wave):
    path = ClosedPath(jnp.array(shapes.CENTRE), jnp.array(wave))
    phase = np.linspace(-1, 8, 20)
    assert_allclose(jax.vmap(path)(phase), shapes.curve(wave, phase), atol=1e-15)
    assert_allclose(jax.vmap(path.slope)(phase), shapes.curve(wave, phase, 1), atol=1e-15)
    assert_allclose(jax.vmap(jax.jacfwd(path))(phase), shapes.curve(wave, phase, 1), atol=1e-15)
    twice = jax.vmap(jax.jacfwd(path.slope))(phase)
    assert_allclose(twice, shapes.curve(wave, phase, 2), atol=1e-14)
    assert_allclose(path(0.0), path(2 * np.pi), atol=1e-15)


@pytest.mark.parametrize("body", [TorqueArm(), MuscleArm(), FreeHand()])
def test_body_on_a_path_moves_as_it_does_alone(body, wave):
    plant, rng = on_path(body, wave), np.random.default_rng(0)
    x = jnp.array(rng.uniform(0.2, 1.0, plant.nx))
    u = jnp.array(rng.uniform(0.1, 0.6, plant.nu))
    assert (plant.nx, plant.nu) == (body.nx + 1, body.nu + 1)
    assert_allclose(plant(x, u, 0.0), [*body(x[:-1], u[:-1], 0.0), u[-1]])
    assert_allclose(plant.hand(x), body.hand(x[:-1]))
    assert_allclose(plant.hand_velocity(x), body.hand_velocity(x[:-1]))
    rule = PolynomialJerk() if isinstance(body, FreeHand) else RK4()
    after = StepOnPath(rule)(plant, x, u, 0.0, 0.01)
    assert_allclose(after, [*rule(body, x[:-1], u[:-1], 0.0, 0.01), x[-1] + 0.01 * u[-1]])


def test_bounds_are_those_of_the_body_and_of_the_phase(wave):
    lower, upper = on_path(MuscleArm(), wave, rate=3.0).control_bounds
    assert_allclose(lower, np.zeros(7))
    assert_allclose(upper, [1, 1, 1, 1, 1, 1, 15])
    lower, upper = on_path(TorqueArm(), wave, rate=3.0).control_bounds
    assert_allclose(lower, [-np.inf, -np.inf, 0])
    assert_allclose(upper, [np.inf, np.inf, 15])


def test_cost_is_the_distance_from_the_path_and_from_the_last_phase(wave):
    body = TorqueArm()
    plant, x = on_path(body, wave), jnp.array([0.7, 1.5, 0.3, -0.2, 2.0])
    u = jnp.array([0.4, -0.3, 2.5])
    miss = np.sum((body.hand(x[:-1]) - shapes.curve(wave, np.array([2.0]))[0]) ** 2)
    pace = np.sum((2.5 * shapes.curve(wave, np.array([2.0]), 1)[0]) ** 2)
    cost = PathCost(30.0, pace_weight=0.1) + jc.OfInner(Effort(2.0))
    wanted = 30 * miss + 0.05 * pace + 0.4**2 + 0.3**2
    problem = Problem(plant, cost, num_steps=1)
    assert_allclose(problem.running(x, u, 0.0), wanted)
    assert_allclose(problem.end(x), 100 * miss + (2.0 - 4 * np.pi) ** 2)


def test_free_timing_of_a_circle_is_uniform_and_completes_its_turns():
    """A circle round the free hand: uniform by symmetry, but for the ends."""
    wave = np.zeros((1, 2, 2))
    wave[0] = 0.05 * np.eye(2)
    body, num_steps, dt = FreeHand(), 100, 0.02
    plant = on_path(body, wave, turns=2.0, rate=2 * np.pi)
    cost = PathCost(30.0) + jc.OfInner(jc.models.PolynomialJerkCost(1e-7, 0.0))
    step = StepOnPath(PolynomialJerk())
    problem = Problem(plant, cost, num_steps=num_steps, dt=dt, integrator=step)
    x0 = jnp.append(body.at_rest(plant.path(0.0)), 0.0)
    solution = jc.solve(problem, jc.ILQR(), x0)
    assert solution.status.ok
    hand, phase = jax.vmap(plant.hand)(solution.xs), solution.xs[:, -1]
    assert_allclose(hand, jax.vmap(plant.path)(phase), atol=2e-3)
    assert_allclose(phase[-1], 4 * np.pi, atol=1e-3)
    assert (np.diff(phase) >= -1e-12).all()
    middle = np.diff(phase[35:65]) / dt
    assert_allclose(middle, middle.mean(), rtol=0.02)


def test_ellipses_have_their_axes_and_scribbles_bend_within_bounds():
    names, waves = shapes.ellipses(8, 3)
    assert len(set(names)) == 8 and waves.shape == (8, 3, 2, 2)
    radii = np.linalg.svd(waves[5, 0], compute_uv=False)
    assert_allclose(radii, [0.05, 0.025])
    assert_allclose(shapes.sharpest(waves[5]), 0.05 / 0.025**2, rtol=1e-4)
    names, waves = shapes.scribbles(3, 3, 300.0)
    assert len(names) == 3 and all(shapes.sharpest(wave) < 300 for wave in waves)
    assert_allclose(waves, shapes.scribbles(3, 3, 300.0)[1])


def test_constant_speed_is_constant(wave):
    at = shapes.at_constant_speed(wave, 2.0, 300)
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1)
    kappa = np.abs(curvature(at, np.arange(301.0)))
    assert_allclose(steps[kappa[:-1] < 30], steps.max(), rtol=0.02)
    once = path_length(shapes.curve(wave, np.linspace(0, 2 * np.pi, 4001)))
    assert_allclose(steps.sum(), 2 * once, rtol=0.01)


def test_two_starts_must_agree_for_a_reach_to_count():
    config = curvature_map.Config(num_steps=2)
    straight, bent = (
        np.array([[0, 0], [0.05, 0], [0.1, 0]]),
        np.array([[0, 0], [0.05, 0.02], [0.1, 0]]),
    )
    hands = np.array([[bent, bent, straight], [bent, straight, bent], [straight, bent, bent]])
    costs = np.array([[1.0, 1.0, np.inf], [1.005, 1.001, np.inf], [2.0, 1.5, np.inf]])
    kept = curvature_map._kept(hands, costs, np.tile([0.1, 0.0], (3, 1)), config)
    assert kept["solved"].tolist() == [True, False, False]
    assert kept["first"].tolist() == [True, True, False]
    assert_allclose(kept["curvature"][0], 0.2)
    assert_allclose(kept["error"], 0, atol=1e-15)


@pytest.mark.parametrize(
    ("bends", "holds"),
    [
        (np.full(20, 0.03), True),
        (np.full(20, -0.03), True),
        (np.full(20, 0.004), False),  # straight
        (np.r_[np.full(18, 0.03), 0.3, 0.3], False),  # a tenth of them bends strongly
        (np.r_[np.full(39, 0.03), 0.3], True),
    ],
)
def test_slightly_curved_is_neither_straight_nor_bent_in_more_than_one_of_twenty(bends, holds):
    found, text = _planned.slightly_curved(bends)
    assert found is holds
    assert text.startswith(f"median {100 * np.median(abs(bends)):.1f} % of the length")


def test_prediction_by_shape_is_that_of_two_cycles_a_turn_on_ellipses_near_the_circle(wave):
    ellipse = np.zeros((3, 2, 2))
    ellipse[0] = [0.05, 0.0], [0.0, 0.048]
    phase = np.linspace(0, 4 * np.pi, 401)
    for path in (ellipse, ellipse[:, ::-1]):  # either way round
        found = _shape_prediction.predicted_exponent(path, phase, 0.0)
        assert_allclose(found, jc.analysis.least_jerk_exponent(2), atol=1e-3)
    assert not _shape_prediction.has_inflections(ellipse)


def test_a_path_with_inflections_has_no_prediction(wave):
    assert _shape_prediction.has_inflections(wave)
    assert np.isnan(_shape_prediction.predicted_exponent(wave, np.linspace(0, 6, 100), 0.0))


def test_two_rounds_of_tangent_count_as_two():
    """A path that turns twice before it closes has components of half a cycle a turn."""
    _, waves = shapes.scribbles(5, 3, 300.0)
    assert not _shape_prediction.has_inflections(waves[4])
    found = _shape_prediction.predicted_exponent(waves[4], np.linspace(0, 4 * np.pi, 801), 0.0)
    low, high = jc.analysis.least_jerk_exponent([3.0, 0.5])
    assert low < found < high


def test_a_valley_without_a_bend_does_not_coincide_with_one():
    def judged(*found):
        return _planned.at_the_bend("", "", [_planned.Valley(*one) for one in found])

    near, none = (0.25, 0.1, 0.26, 5.0), (np.nan, 0.0, np.nan, np.nan)
    assert judged(near, none).holds and "1 of 2 movements" in judged(near, none).measured
    assert not judged(near, (0.25, 0.1, 0.30, 5.0)).holds
    assert not judged(near, (0.25, 0.1, np.nan, np.nan)).holds
    assert not judged(none).holds and judged(none).note


@pytest.mark.parametrize(
    ("module", "setting", "message"),
    [
        (centre_out, {"motor_noise": float("nan")}, "motor_noise: a finite number above 0"),
        (centre_out, {"radius": -0.1}, "radius: a finite number above 0"),
        (curvature_map, {"distance": -0.1}, "distance: a finite number above 0"),
        (chapter_3, {"active_states": "linear; linear"}, "active_states: each once"),
        (fig_3_4, {"active_state": "bron"}, "active_state: one of"),
    ],
)
def test_settings_without_meaning_are_refused(module, setting, message):
    with pytest.raises(ValueError, match=message):
        module.Config(**setting)


def test_a_claim_that_is_nan_does_not_hold():
    assert not Claim("", "", "", "", float("nan")).holds
