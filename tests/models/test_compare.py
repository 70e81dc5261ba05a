"""One task under several models, side by side."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.models import MinimumEnergy, MinimumJerk, MinimumTorqueChange, WeightedSum

TARGET, POINT = jnp.array([-0.1, 0.53]), jnp.array([[0.02, 0.48]])
MODELS = (MinimumEnergy(), MinimumTorqueChange(), MinimumJerk())


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(0.785, 1.571)


@pytest.fixture(scope="module")
def task(arm):
    return jc.tasks.reach(arm, TARGET, 0.5, num_steps=20)


@pytest.fixture(scope="module")
def comparison(task, x0):
    return jc.compare(MODELS, task, x0)


def test_the_table_has_a_row_for_each_model(comparison):
    lines = str(comparison).splitlines()
    assert comparison.ok and len(lines) == 2 + 3
    for line, model, speeds in zip(lines[2:], MODELS, comparison.speeds, strict=True):
        assert line.startswith(model.name) and f"{speeds.max():.3f}" in line
        assert "CONVERGED" in line
    assert lines[0].split()[0] == "model"


def test_its_numbers_are_those_of_separate_solves(comparison, task, arm, x0):
    for i, model in enumerate(MODELS):
        problem = model.problem(task)
        solution = jc.solve(problem, jc.DDP(), model.start(task, x0), max_steps=500)
        np.testing.assert_allclose(comparison.solutions[i].us, solution.us, rtol=1e-9, atol=1e-12)
        hands = [problem.plant.hand(x) for x in solution.xs]
        np.testing.assert_allclose(comparison.hands[i], hands, atol=1e-12)
        speeds = [np.linalg.norm(problem.plant.hand_velocity(x)) for x in solution.xs]
        np.testing.assert_allclose(comparison.speeds[i], speeds, atol=1e-12)
    assert comparison.hands.shape == comparison.velocities.shape == (3, 21, 2)
    np.testing.assert_allclose(comparison.ts, np.linspace(0, 0.5, 21), atol=1e-15)
    np.testing.assert_allclose(comparison.hands[:, -1], 3 * [TARGET], atol=1e-3)


def test_distances_are_symmetric_with_a_zero_diagonal(comparison):
    d = comparison.distances
    assert d.shape == (3, 3)
    np.testing.assert_allclose(d, d.T, rtol=1e-12)
    np.testing.assert_array_equal(np.diag(d), 0)
    assert (d[~np.eye(3, dtype=bool)] > 1e-4).all() and d.max() < 0.05


def test_a_figure_names_its_models_in_a_legend(comparison):
    figure = comparison.figure()
    assert isinstance(figure, matplotlib.figure.Figure)
    texts = [
        text.get_text()
        for axes in figure.axes
        if axes.get_legend() is not None
        for text in axes.get_legend().get_texts()
    ]
    assert all(texts.count(name) == 1 for name in comparison.names), texts
    plt.close(figure)


def test_a_figure_shows_via_points_and_obstacles(arm, x0):
    disc = jc.tasks.Obstacle(jnp.array([-0.2, 0.4]), jnp.asarray(0.02), 1e-12)
    via = jc.tasks.via(arm, TARGET, POINT, [0.2], 0.5, num_steps=20)
    task = jc.Problem(arm, via.cost + disc, num_steps=20, dt=0.025)
    with pytest.warns(UserWarning, match=r"try MinimumJerk\(1e-8\)"):
        comparison = jc.compare(MinimumJerk(), task, x0, jc.ILQR())
    figure = comparison.figure()
    assert isinstance(figure, matplotlib.figure.Figure)
    plt.close(figure)


def test_names_are_numbered_where_they_repeat(task, x0):
    comparison = jc.compare((MinimumJerk(), MinimumJerk(1e-11), MinimumEnergy()), task, x0)
    assert comparison.names == ("minimum jerk 1", "minimum jerk 2", "minimum energy")
    assert comparison.distances[0, 1] < 1e-5


def test_a_solve_that_fails_is_told(comparison):
    stopped = jc.Status.of(jc.Reason.MAX_STEPS)
    energy, *others = comparison.solutions
    failed = eqx.tree_at(lambda s: s.status, energy, stopped)
    other = dataclasses.replace(comparison, solutions=(failed, *others))
    assert comparison.ok and not other.ok
    assert str(other).splitlines()[-1] == f"minimum energy: {stopped.message}"
    assert "MAX_STEPS" in str(other).splitlines()[2]


@pytest.mark.parametrize(
    ("models", "error", "match"),
    [
        (MinimumJerk, TypeError, r"^models: .*write MinimumJerk\(\)"),
        ([MinimumJerk], TypeError, r"^models: .*write MinimumJerk\(\)"),
        ([], ValueError, "^models: at least one"),
        (["minimum jerk"], TypeError, "^models: a model is wanted, got 'minimum jerk'"),
    ],
)
def test_misuse_is_named(task, x0, models, error, match):
    with pytest.raises(error, match=match):
        jc.compare(models, task, x0)


def test_what_does_not_fit_a_model_is_refused(arm, x0, task):
    posture = jc.tasks.posture(arm, jnp.array([1.0, 1.3]), num_steps=20)
    with pytest.raises(
        TypeError, match=r"^task: minimum jerk moves the hand alone and has no Post"
    ):
        jc.compare([MinimumEnergy(), MinimumJerk()], posture, x0)
    with pytest.raises(TypeError, match=r"^task: a problem such as"):
        jc.compare(MinimumJerk(), "reach", x0)
    with pytest.raises(ValueError, match=r"^x0: got shape \(6,\)"):
        jc.compare(WeightedSum([MinimumJerk()], [1.0]), task, jnp.zeros(6))


def test_a_tracked_path_is_measured_by_the_distance_from_it(arm, x0):
    path = arm.hand(x0) + jnp.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.0]])
    task = jc.tasks.track(arm, path, 0.6, num_steps=30)
    comparison = jc.compare(MinimumEnergy(), task, x0)
    wanted = np.stack([np.interp(task.ts, [0, 0.3, 0.6], column) for column in path.T], axis=1)
    rms = 1e3 * np.sqrt(np.mean(np.sum((comparison.hands[0] - wanted) ** 2, axis=1)))
    assert f"{rms:.2f}" in str(comparison).splitlines()[2].split()


def test_traced_values_are_refused_with_what_to_use_instead(arm, x0):
    task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=20)
    with pytest.raises(ValueError, match=r"jc\.solve\(model\.problem\(task\)"):
        jax.jit(lambda x: jc.compare(MinimumEnergy(), task, x).hands)(x0)
    with pytest.raises(ValueError, match="known values are wanted"):
        jax.jit(lambda x: jc.optimise_times(task, jc.DDP(), x, duration=(0.2, 1.0)).value)(x0)
