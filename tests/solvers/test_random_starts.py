"""A hundred starts of the muscle arm in one vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc


@pytest.mark.slow
def test_lanes_of_the_muscle_arm_equal_their_solo_runs():
    arm = jc.plants.MuscleArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    problem = jc.tasks.reach(arm, arm.hand(x0) + jnp.array([-0.08, 0.08]), 0.5)
    levels = jax.random.uniform(jax.random.key(0), (100, 1, arm.nu), maxval=0.2)
    starts = jnp.broadcast_to(levels, (100, problem.num_steps, arm.nu))
    early, ended = (_both(problem, x0, starts, max_steps) for max_steps in (2, 500))
    ok = np.asarray(ended[0].status.ok)
    assert ok.sum() >= 95, str(ended[0])
    for lane in range(0, 100, 5):
        batch, solo = early[0], early[1](starts[lane])
        np.testing.assert_allclose(batch.us[lane], solo.us, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(batch.xs[lane], solo.xs, rtol=1e-7, atol=1e-9)
        # Compiled otherwise, sums round otherwise, and where the muscles' kinks leave several
        # optima side by side, that decides in which one it ends.
        batch, solo = ended[0], ended[1](starts[lane])
        assert bool(solo.status.ok) == bool(ok[lane])
        if ok[lane]:
            np.testing.assert_allclose(batch.cost[lane], solo.cost, rtol=1e-4)


def _both(problem, x0, starts, max_steps):
    """Return the solutions of all lanes, and the solve of one."""
    solve = jax.jit(lambda us: jc.solve(problem, jc.ILQR(), x0, us, max_steps=max_steps))
    return jax.jit(jax.vmap(solve))(starts), solve
