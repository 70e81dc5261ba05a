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


FLAGS = {
    "ranks": lambda: jax.numpy_rank_promotion("raise"),
    "dtypes": lambda: jax.numpy_dtype_promotion("strict"),
    "nan": lambda: jax.debug_nans(True),
}
SOLVES = [
    ("discrete", jc.ILQR()),
    ("pendulum, bounded", jc.DDP()),
    ("muscle arm, reach", jc.ILQR()),
]


@pytest.mark.parametrize("flag", FLAGS)
@pytest.mark.parametrize(("name", "solver"), SOLVES)
def test_flags_of_the_application_do_not_disturb_a_solve_or_a_simulation(name, solver, flag):
    with FLAGS[flag]():
        problem, x0 = PROBLEMS[name]()
        solution = jc.solve(problem, solver, x0, max_steps=3)
        batch = jc.solve_batch(problem, solver, x0[None], max_steps=3)
        trajectory = jc.simulate(problem, solution.policy, x0)
    assert jnp.isfinite(trajectory.cost) and jnp.isfinite(solution.cost)
    assert jnp.array_equal(batch.us[0], solution.us)


@pytest.mark.parametrize("flag", FLAGS)
def test_flags_of_the_application_do_not_disturb_a_gradient(flag):
    problem, x0 = PROBLEMS["discrete"]()
    cost = lambda x0: jc.solve(problem, jc.ILQR(), x0).cost  # noqa: E731
    want = jax.grad(cost)(x0)
    with FLAGS[flag]():
        assert jnp.array_equal(jax.grad(cost)(x0), want)


def test_the_application_keeps_its_flags():
    problem, x0 = PROBLEMS["discrete"]()
    with jax.numpy_rank_promotion("raise"):
        jc.solve(problem, jc.ILQR(), x0, max_steps=1)
        with pytest.raises(ValueError, match="rank_promotion"):
            _ = jnp.ones((2, 2)) + jnp.ones(2)
