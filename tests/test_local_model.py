"""The expansion against the dense Hessian of the cost as a function of all controls."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl._local_model import expand
from jaxctrl.linear import costates, lqr, lqr_rollout


def dynamics(x, u, t, p):
    force = p * jnp.sin(x[0]) + u[0] * jnp.cos(x[1] + t) + 0.3 * u[1] ** 2
    return jnp.array([x[1] + 0.2 * u[1], force])


def problem(integrator=None, times=(0.1, 0.23, 0.6)):
    cost = jc.FunctionCost(
        running=lambda x, u, t: (
            0.8 * jnp.sum(u**2) + 0.1 * x[0] ** 4 + 0.05 * u[0] * x[1] * (1 + t)
        ),
        terminal=lambda x: jnp.sum((x - 1) ** 2) + 0.1 * x[0] ** 4,
        event=lambda x, i: (1.0 + i) * (jnp.sin(x[0]) - 0.2) ** 2,
        event_times=times,
    )
    plant = jc.FunctionPlant(dynamics, nx=2, nu=2, params=3.0)
    return jc.Problem(plant, cost, num_steps=6, dt=0.1, integrator=integrator)


def dense(problem, x0, us):
    def cost(flat):
        us_ = flat.reshape(us.shape)
        return problem.total_cost(problem.rollout(x0, us_), us_)

    flat = us.ravel()
    return jax.grad(cost)(flat), jax.hessian(cost)(flat)


@pytest.mark.parametrize("integrator", [jc.Euler(), jc.RK4()])
def test_second_order_expansion_gives_newtons_step_and_gradient(integrator):
    prob, x0 = problem(integrator), jnp.array([0.4, -0.3])
    us = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)))
    g, H = dense(prob, x0, us)
    assert np.linalg.eigvalsh(H)[0] > 0
    model = jc.expand(prob, prob.rollout(x0, us), us, second_order=True)
    np.testing.assert_allclose(costates(model)[1].ravel(), g, rtol=1e-9, atol=1e-12)
    sweep = lqr(model)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(2))
    np.testing.assert_allclose(dus.ravel(), -np.linalg.solve(H, g), rtol=1e-8, atol=1e-10)


def test_first_order_expansion_gives_the_same_gradient_and_another_step():
    prob, x0 = problem(), jnp.array([0.4, -0.3])
    us = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)))
    g, H = dense(prob, x0, us)
    model = jc.expand(prob, prob.rollout(x0, us), us)
    np.testing.assert_allclose(costates(model)[1].ravel(), g, rtol=1e-9, atol=1e-12)
    sweep = lqr(model)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(2))
    assert np.abs(dus.ravel() + np.linalg.solve(H, g)).max() > 1e-3


def test_declared_quadratic_costs_expand_like_undeclared_ones():
    x0 = jnp.array([0.4, -0.3])
    us = jnp.asarray(np.random.default_rng(1).normal(size=(6, 2)))
    Q = jnp.array([[1.0, 0.2], [0.2, 2.0]])
    declared = jc.QuadraticCost(Q=Q, R=jnp.array([0.1, 0.2]), Qf=3.0, target=jnp.array([1.0, 0]))
    plain = jc.FunctionCost(
        running=lambda x, u, t: declared.running(None, x, u, t),
        terminal=lambda x: declared.terminal(None, x),
    )
    models = []
    for cost in (declared, plain):
        prob = jc.Problem(problem().plant, cost, num_steps=6, dt=0.1)
        models.append(jc.expand(prob, prob.rollout(x0, us), us))
    for one, two in zip(*map(jax.tree.leaves, models), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-14)


def test_event_on_a_grid_point_equals_a_terminal_cost():
    plant, us = problem().plant, jnp.ones((6, 2))
    x0 = jnp.array([0.4, -0.3])

    def value(x):
        return jnp.sum((x - 1) ** 2)

    end = jc.Problem(plant, jc.FunctionCost(terminal=value), num_steps=6, dt=0.1)
    event = jc.FunctionCost(event=lambda x, i: value(x), event_times=jnp.array([0.6]))
    at = jc.Problem(plant, event, num_steps=6, dt=0.1)
    xs = end.rollout(x0, us)
    np.testing.assert_allclose(at.total_cost(xs, us), end.total_cost(xs, us), rtol=1e-12)


def test_cost_is_differentiable_in_the_times_of_events():
    x0, us = jnp.array([0.4, -0.3]), jnp.ones((6, 2))

    def cost(times):
        prob = problem(times=times)
        return prob.total_cost(prob.rollout(x0, us), us)

    times, h = jnp.array([0.12, 0.23, 0.57]), 1e-6
    for i, slope in enumerate(jax.grad(cost)(times)):
        step = jnp.zeros(3).at[i].set(h)
        difference = (cost(times + step) - cost(times - step)) / (2 * h)
        np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_event_outside_the_movement_is_refused_or_makes_the_cost_nan():
    with pytest.raises(ValueError, match=r"event at 0.7 s lies outside"):
        problem(times=(0.1, 0.2, 0.7))

    def cost(times):
        prob = problem(times=times)
        return prob.total_cost(prob.rollout(jnp.zeros(2), jnp.ones((6, 2))), jnp.ones((6, 2)))

    assert jnp.isnan(jax.jit(cost)(jnp.array([0.1, 0.2, 0.7])))


@pytest.mark.parametrize("second_order", [False, True])
def test_the_public_expansion_is_compiled_once_for_all_numbers(second_order):
    """Equal to the plain one that solvers have inside their loops, and traced no second time."""
    traced, one = [], problem()

    def counted(x, u, t, p):
        traced.append(1)
        return dynamics(x, u, t, p)

    plant = jc.FunctionPlant(counted, nx=2, nu=2, params=3.0)
    counting = jc.Problem(plant, one.cost, num_steps=6, dt=0.1)
    us = np.linspace(-0.4, 0.5, 12).reshape(6, 2)
    for factor in (1.0, 0.7):
        other = eqx.tree_at(lambda p: p.plant.params, counting, jnp.array(2.0 * factor))
        xs = other.rollout(jnp.array([0.3, -0.2]), jnp.asarray(us))
        before = len(traced)
        model = jc.expand(other, xs, us, second_order=second_order)
        assert (len(traced) > before) == (factor == 1.0)
        plain = expand(other, xs, us, second_order=second_order)
        for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(plain), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
