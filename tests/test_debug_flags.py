"""Plants, costs and kernels make no NaN on the way, not even one that is masked afterwards."""

import jax
import jax.numpy as jnp
import pytest
from problems import PROBLEMS

import jaxctrl as jc
from jaxctrl.linear import box_lqr, lqr, lqr_rollout

NAMES = ["discrete", "pendulum, bounded", "torque arm, hit", "muscle arm, obstacle", "chain of 4"]


@pytest.mark.parametrize("name", NAMES)
def test_expansion_sweeps_and_rollouts_pass_with_debug_nans(name):
    with jax.debug_nans(True):
        problem, x0 = PROBLEMS[name]()

        @jax.jit
        def everything(x0, us):
            xs = problem.rollout(x0, us)
            gradient = jax.grad(lambda us: problem.total_cost(problem.rollout(x0, us), us))(us)
            model = jc.expand(problem, xs, us, second_order=True)
            sweep = lqr(jc.expand(problem, xs, us), 1.0)
            boxed, _ = box_lqr(model, -0.1 - us, 0.1 - us, 10.0)
            return gradient, sweep, boxed, lqr_rollout(model, sweep.k, sweep.K, 0 * x0)

        out = everything(x0, jnp.array(problem.nominal_controls))
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
