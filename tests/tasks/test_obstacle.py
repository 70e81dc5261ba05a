"""Detours around an obstacle: how wide they are, and that nothing is cut between the samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl import analysis

RADIUS = 0.02
# Recorded from a separate implementation of the arm, the cost and the solver (NumPy).
BY_WEIGHT = {1e-7: 50.2e-3, 1e-8: 41.1e-3, 1e-9: 25.7e-3, 1e-10: 14.4e-3, 1e-11: 9.0e-3}
BY_DURATION = {0.7: 41.1e-3, 0.5: 32.6e-3, 0.35: 23.6e-3, 0.2: 13.9e-3}


@pytest.fixture(scope="module")
def clearance():
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(np.pi / 4, np.pi / 2)
    start, offset = arm.hand(x0), jnp.array([-0.12, 0.09])
    centre = start + offset / 2 + jnp.array([0.003, 0.004])

    def measure(weight, duration):
        problem = jc.tasks.obstacle(
            arm,
            start + offset,
            centre,
            RADIUS,
            duration,
            obstacle_weight=weight,
            num_steps=round(duration / 0.01),
        )
        solution = jc.solve(problem, jc.ILQR(), x0)
        assert solution.status.ok
        hands = jax.vmap(arm.hand)(solution.xs)
        assert jnp.linalg.norm(hands[-1] - start - offset) < 2.5e-3
        between = analysis.clearance(hands, centre, RADIUS)
        at_samples = jnp.linalg.norm(hands - centre, axis=1).min() - RADIUS
        assert 0 < between <= at_samples
        return between

    return measure


def test_the_clearance_grows_with_the_obstacles_weight_as_found_elsewhere(clearance):
    found = [clearance(weight, 0.7) for weight in BY_WEIGHT]
    np.testing.assert_allclose(found, list(BY_WEIGHT.values()), rtol=0.02)
    assert (np.diff(found) < 0).all()


def test_the_clearance_grows_with_the_duration_as_found_elsewhere(clearance):
    found = [clearance(1e-8, duration) for duration in BY_DURATION]
    np.testing.assert_allclose(found, list(BY_DURATION.values()), rtol=0.02)
    assert (np.diff(found) < 0).all()
