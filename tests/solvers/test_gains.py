"""Gains: whose they are, and their derivatives, against differences of solves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl._local_model import expand
from jaxctrl.linear import factorise

TOLERANCES = {"gradient_tolerance": 1e-11, "cost_tolerance": 1e-14, "step_tolerance": 1e-13}
TARGET = jnp.array([-0.1, 0.53])


@pytest.fixture(scope="module")
def arm():
    arm = jc.plants.TorqueArm()
    return arm, arm.at_rest(shoulder=0.785, elbow=1.571)


def reach(arm, effort, bounds):
    problem = jc.tasks.reach(arm, TARGET, 0.5, num_steps=25, effort=effort)
    return jc.Problem(
        problem.plant, problem.cost, num_steps=25, dt=problem.dt, control_bounds=bounds
    )


def in_a_curl_field(arm, x0, solver, bounds):
    """Return (weighed gains, cost of a disturbed run in a field) as functions of the effort."""

    def outputs(effort):
        problem = reach(arm, effort, bounds)
        solution = jc.solve(problem, solver, x0, max_steps=200)
        field = jc.plants.InField(arm, jc.plants.Curl(5.0))
        aside = x0 + jnp.array([0.02, -0.01, 0.1, 0.2])
        run = jc.simulate(problem, solution.policy, aside, plant=field)
        weights = jnp.cos(jnp.arange(solution.policy.K.size)).reshape(solution.policy.K.shape)
        return jnp.stack([jnp.sum(weights * solution.policy.K), run.cost])

    return jax.jit(outputs)


@pytest.mark.parametrize("bounds", [None, (-0.5, 0.5)])
@pytest.mark.parametrize("kind", [jc.ILQR, jc.DDP])
def test_derivatives_of_gains_and_of_a_run_under_them_are_differences(arm, kind, bounds):
    outputs = in_a_curl_field(*arm, kind(**TOLERANCES), bounds)
    effort, h = 1e-4, 2e-7
    values = [np.asarray(outputs(effort + i * h)) for i in (-2, -1, 1, 2)]
    difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    forward = jax.jit(lambda r: jax.jvp(outputs, (r,), (1.0,))[1])(effort)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacrev(outputs))(effort), forward, rtol=1e-10)


def test_gains_of_a_solve_that_did_not_converge_have_nan_derivatives(arm):
    arm, x0 = arm

    def gains(effort, weight):
        problem = reach(arm, effort, (-0.5, 0.5))
        return weight * jnp.sum(jc.solve(problem, jc.DDP(), x0, max_steps=1).policy.K)

    assert np.isnan(jax.grad(gains)(1e-4, 1.0))
    assert jax.grad(gains)(1e-4, 0.0) == 0.0


@pytest.mark.parametrize("kind", [jc.ILQR, jc.DDP])
@pytest.mark.parametrize("bounds", [None, (-0.5, 0.5)])
def test_gains_are_those_of_the_solvers_own_model_whatever_the_start(arm, kind, bounds):
    arm, x0 = arm
    problem = reach(arm, 1e-4, bounds)
    first = jc.solve(problem, kind(), x0)
    model = eqx.filter_jit(expand)(problem, first.xs, first.us, second_order=kind is jc.DDP)
    free = jnp.ones(first.us.shape, bool) if bounds is None else jnp.abs(first.us) < bounds[1]
    assert bounds is None or not free.all()
    wanted = factorise(model, free).K
    np.testing.assert_allclose(first.policy.K, wanted, rtol=1e-9, atol=1e-9)
    for steps in (0, 500):
        again = jc.solve(problem, kind(), x0, first.us, max_steps=steps)
        np.testing.assert_array_equal(again.us, first.us)
        np.testing.assert_allclose(again.policy.K, wanted, rtol=1e-9, atol=1e-9)
    other = jc.solve(problem, kind(**TOLERANCES), x0, first.us + 0.1)
    np.testing.assert_allclose(other.policy.K, wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", [jc.ILQR, jc.DDP])
def test_controls_that_settle_at_a_bound_are_on_it_and_follow_it(arm, kind):
    arm, x0 = arm
    bound = 0.1 + 0.2  # no round number in binary

    def solve(upper, us):
        return jc.solve(reach(arm, 1e-4, (-0.45, upper)), kind(), x0, us)

    starts = 0.2 * jax.random.normal(jax.random.key(0), (4, 25, 2))
    solutions = jax.vmap(lambda us: solve(bound, us))(starts)
    assert solutions.status.ok.all()
    slopes = jax.vmap(lambda us: jax.jacfwd(lambda b: solve(b, us).us)(bound))(starts)
    distance = np.minimum(bound - np.asarray(solutions.us), np.asarray(solutions.us) + 0.45)
    assert ((distance == 0) | (distance > 1e-6)).all()
    at_upper = np.asarray(solutions.us) == bound
    assert at_upper.sum() >= 4
    np.testing.assert_array_equal(np.asarray(slopes)[at_upper], 1.0)
    np.testing.assert_array_equal(np.asarray(slopes)[np.asarray(solutions.us) == -0.45], 0.0)
    # All four are one optimum, and have one derivative of its cost.
    by_bound = jax.vmap(lambda us: jax.grad(lambda b: solve(b, us).cost)(bound))(starts)
    np.testing.assert_allclose(by_bound, by_bound[0], rtol=1e-3)
