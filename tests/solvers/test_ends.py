"""How solves end where curvature, cost or gradient vanish, and where the cost has no end."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

SOLVERS = [jc.ILQR, jc.DDP]


def integrator(terminal, bounds=None):
    plant = jc.FunctionPlant(lambda x, u, t: u, nx=1, nu=1)
    cost = jc.FunctionCost(terminal=terminal)
    return jc.Problem(plant, cost, num_steps=10, dt=0.1, control_bounds=bounds)


def pendulum(running, terminal, steps=20):
    cost = jc.FunctionCost(running=running, terminal=terminal)
    return jc.Problem(jc.plants.Pendulum(), cost, num_steps=steps, dt=0.05)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_optimum_at_the_start_is_a_success(solver):
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    hanging = pendulum(lambda x, u, t: 1e-3 * u[0] ** 2, lambda x: 100 * (1 + jnp.cos(x[0])))
    for problem, start, cost in (
        (hanging, jnp.array([jnp.pi, 0.0]), 0.0),
        (pendulum(None, lambda x: 3.0 + 0 * x[0]), jnp.array([1.0, 0.0]), 3.0),
        (jc.tasks.reach(arm, arm.hand(x0), 0.2), x0, 0.0),
    ):
        solution = jc.solve(problem, solver(), start)
        assert solution.status.is_(jc.Reason.STATIONARY_START), solution
        assert solution.num_steps == 0 and abs(solution.cost - cost) <= 1e-14


@pytest.mark.parametrize("solver", SOLVERS)
def test_muscles_switch_off_for_a_goal_where_the_hand_is(solver):
    arm = jc.plants.MuscleArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    solution = jc.solve(jc.tasks.reach(arm, arm.hand(x0), 0.2), solver(), x0)
    assert solution.status.ok and solution.cost <= 1e-20


def mayer(weight):
    """A quadratic problem whose whole cost is a further state at the end."""

    def dynamics(x, u, t):
        return jnp.stack([u[0] - x[0], x[0] ** 2 + u[0] ** 2 + (u[0] - 1) ** 2])

    plant = jc.FunctionPlant(dynamics, nx=2, nu=1)
    cost = jc.FunctionCost(terminal=lambda x: weight * x[1])
    return jc.Problem(plant, cost, num_steps=20, dt=0.1), jnp.array([1.0, 0.0])


def lagrange():
    def running(x, u, t):
        return x[0] ** 2 + u[0] ** 2 + (u[0] - 1) ** 2

    plant = jc.FunctionPlant(lambda x, u, t: u - x, nx=1, nu=1)
    problem = jc.Problem(plant, jc.FunctionCost(running=running), num_steps=20, dt=0.1)
    return problem, jnp.array([1.0])


def test_a_cost_linear_in_the_last_state_alone_is_solved_in_any_unit():
    wanted = jc.solve(lagrange()[0], jc.DDP(), lagrange()[1])
    for weight in (1.0, 1e3, 1e-3, 1e6, 1e-6):
        solution = jc.solve(mayer(weight)[0], jc.DDP(), mayer(weight)[1])
        assert solution.status.ok and solution.num_steps <= 4, solution
        np.testing.assert_allclose(solution.us, wanted.us, atol=1e-6)
        np.testing.assert_allclose(solution.cost, weight * wanted.cost, rtol=1e-9)


@pytest.mark.parametrize("weight", [1.0, 1e3, 1e-6])
def test_without_any_curvature_ilqr_goes_down_the_gradient(weight):
    bounded = jc.solve(integrator(lambda x: weight * x[0], (-1.0, 1.0)), jc.ILQR(), jnp.ones(1))
    assert bounded.status.ok
    np.testing.assert_array_equal(bounded.us, -1.0)
    problem, x0 = mayer(weight)
    free = jc.solve(problem, jc.ILQR(), x0)
    assert not free.status.is_(jc.Reason.REGULARISATION_EXHAUSTED)
    np.testing.assert_allclose(
        free.cost, weight * jc.solve(lagrange()[0], jc.DDP(), lagrange()[1]).cost, rtol=1e-6
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_cost_without_end_has_its_own_status(solver):
    for terminal in (lambda x: -(x[0] ** 2), lambda x: x[0]):
        solution = jc.solve(integrator(terminal), solver(), jnp.ones(1))
        assert solution.status.is_(jc.Reason.UNBOUNDED_COST) and not solution.status.ok


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_settled_pendulum_under_predictive_control_goes_on_converging(solver):
    """1 - cos is known to eps, however near the goal: costs tell nothing there."""
    problem = pendulum(
        lambda x, u, t: 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 1e-3 * u[0] ** 2,
        lambda x: 10 * (1 - jnp.cos(x[0])) + x[1] ** 2,
    )
    x, us, names = jnp.array([0.3, 0.0]), None, []
    for _ in range(130):
        solution = jc.solve(problem, solver(), x, us)
        names.append(solution.status.name)
        assert solution.status.ok, (len(names), solution)
        x = problem.step(x, solution.us[0], 0.0)
        us = jnp.concatenate([solution.us[1:], solution.us[-1:]])
    assert np.abs(x).max() < 1e-5
