"""Limits of joints: an elbow does not bend backwards, and what is no limit costs nothing."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


def test_it_costs_the_squared_excess_over_time(arm):
    task = jc.tasks.reach(arm, jnp.array([0.0, 0.5]), 0.5, num_steps=10, effort=0.0)
    limited = jc.tasks.limit_joints(task, [-np.inf, 0.0], [1.0, 2.0], weight=3.0)
    xs = jnp.zeros((11, 4)).at[:, 0].set(1.2).at[:, 1].set(-0.3)
    added = limited.total_cost(xs, jnp.zeros((10, 2))) - task.total_cost(xs, jnp.zeros((10, 2)))
    np.testing.assert_allclose(added, 0.5 * 3.0 * (0.2**2 + 0.3**2), rtol=1e-9)
    inside = jnp.zeros((11, 4)).at[:, 1].set(1.0)
    assert limited.total_cost(inside, jnp.zeros((10, 2))) == task.total_cost(
        inside, jnp.zeros((10, 2))
    )


def test_without_limits_the_elbow_turns_backwards_and_with_them_it_does_not(arm):
    x0 = arm.at_rest(shoulder=1.2, elbow=1.5)
    free = jc.tasks.via(arm, [0.2, 0.4], [[0.0, 0.58]], [0.25], 0.5)
    model = jc.models.MinimumTorqueChange()
    lowest = []
    for task in (free, jc.tasks.limit_joints(free, [-1.0, 0.0], [2.5, 2.6])):
        solution = jc.solve(model.problem(task), jc.DDP(), model.start(task, x0))
        assert solution.status.ok
        lowest.append(float(solution.xs[:, 1].min()))
    assert lowest[0] < -0.5 < 0.0 < lowest[1]


def test_what_does_not_fit_is_refused(arm):
    task = jc.tasks.reach(arm, jnp.array([0.0, 0.5]))
    with pytest.raises(ValueError, match="lower, upper: the lower bound has shape"):
        jc.tasks.limit_joints(task, [0.0, 0.0, 0.0], 1.0)
    with pytest.raises(ValueError, match="lower: at most upper is wanted"):
        jc.tasks.limit_joints(task, 1.0, 0.0)
    with pytest.raises(ValueError, match=r"^upper: .* are these radians\?"):
        jc.tasks.limit_joints(task, [0, 0], [120, 150])
    with pytest.raises(ValueError, match=r"^lower: .* are these radians\?"):
        jc.tasks.limit_joints(task, [-90, -np.inf], np.inf)
    with pytest.raises(ValueError, match="weight: at least 0"):
        jc.tasks.limit_joints(task, 0.0, 1.0, weight=-1.0)
    free = jc.plants.FreeHand()
    with pytest.raises(TypeError, match="problem: one of a plant with joints"):
        jc.tasks.limit_joints(jc.tasks.reach(free, jnp.array([0.0, 0.5])), 0.0, 1.0)
