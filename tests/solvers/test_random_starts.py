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
    solve = jax.jit(lambda us: jc.solve(problem, jc.ILQR(), x0, us))
    batch = jax.jit(jax.vmap(lambda us: jc.solve(problem, jc.ILQR(), x0, us)))(starts)
    ok = np.asarray(batch.status.ok)
    assert ok.sum() >= 95, str(batch)
    for lane in range(0, 100, 5):
        solo = solve(starts[lane])
        assert solo.status.code == batch.status.code[lane]
        assert solo.num_steps == batch.num_steps[lane]
        if ok[lane]:
            np.testing.assert_allclose(batch.cost[lane], solo.cost, rtol=1e-8)
            np.testing.assert_allclose(batch.us[lane], solo.us, atol=1e-8)
            np.testing.assert_allclose(batch.xs[lane], solo.xs, atol=1e-8)
