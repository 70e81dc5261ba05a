"""DDP: the optimum of ILQR, reached with gradients that are squared instead of scaled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS

import jaxctrl as jc


def gradients(solution):
    """Return the projected gradient of each iterate."""
    return np.asarray(solution.history.gradient)[: int(solution.num_steps) + 1]


@pytest.mark.parametrize("name", ["pendulum", "torque arm, reach"])
def test_last_gradients_fall_quadratically_where_those_of_ilqr_fall_linearly(name):
    problem, x0 = PROBLEMS[name]()
    ilqr = jc.solve(problem, jc.ILQR(), x0)
    ddp = jc.solve(problem, jc.DDP(gradient_tolerance=1e-10), x0)
    assert ilqr.status.ok and ddp.status.ok
    np.testing.assert_allclose(ddp.cost, ilqr.cost, rtol=1e-8)
    np.testing.assert_allclose(ddp.us, ilqr.us, atol=1e-3 * float(jnp.abs(ilqr.us).max()))
    g, linear = gradients(ddp), gradients(ilqr)
    print(name, "DDP", g[-5:], "ILQR", linear[-5:])
    near = g[:-1][(g[:-1] < 0.9) & (g[:-1] > 1e-6)]
    after = g[1:][(g[:-1] < 0.9) & (g[:-1] > 1e-6)]
    assert len(near) >= 2
    # Each order of convergence, log g_{k+1} / log g_k, near 2; rounding ends it at about 1e-10.
    orders = np.log(after[-2:]) / np.log(near[-2:])
    assert (orders > 1.5).all() or (after[-1] < 1e-9)
    assert (linear[-2:] / linear[-3:-1] > 0.01).all()


QUICK = ["discrete", "pendulum, bounded", "torque arm, via", "muscle arm, reach"]
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in PROBLEMS if name not in QUICK]


@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_ddp_ends_no_higher_than_ilqr(name):
    problem, x0 = PROBLEMS[name]()
    ddp, ilqr = (jc.solve(problem, solver, x0) for solver in (jc.DDP(), jc.ILQR()))
    assert ddp.status.ok, ddp.status.message
    assert ddp.cost <= ilqr.cost * (1 + 1e-3)
    # Around the obstacle neither model is convex at the start: both are tried, damped ever more;
    # of 51 iterations 28 lead to nothing.
    further = 30 if name == "muscle arm, obstacle" else 5
    assert ddp.num_steps <= ilqr.num_steps + further
    n = int(ddp.num_steps) + 1
    falls = np.diff(np.asarray(ddp.history.cost)[:n])
    assert (falls <= 1e-14 * np.abs(float(ddp.history.cost[0]))).all()


def test_negative_curvature_is_followed_down_and_not_called_an_optimum():
    # In x' = -u^2 + u^4 every u = 0 is a stationary maximum of the cost x(T).
    def dynamics(x, u, t):
        return jnp.array([-(u[0] ** 2) + u[0] ** 4])

    plant = jc.FunctionPlant(dynamics, nx=1, nu=1, nominal_control=0.05)
    cost = jc.FunctionCost(running=lambda x, u, t: 1e-3 * u[0] ** 2, terminal=lambda x: x[0])
    problem = jc.Problem(plant, cost, num_steps=10, dt=0.1)
    solution = jc.solve(problem, jc.DDP(), jnp.zeros(1))
    assert solution.status.ok
    best = np.sqrt((1 - 1e-3) / 2)
    np.testing.assert_allclose(np.abs(solution.us), best, rtol=1e-6)


def test_tolerances_far_below_the_costs_round_off_are_reached():
    problem, x0 = PROBLEMS["torque arm, reach, bounded"]()
    solution = jc.solve(problem, jc.DDP(gradient_tolerance=1e-12), x0)
    assert solution.status.ok and solution.gradient <= 1e-12


def test_ddp_in_float32_reaches_the_float64_cost(float32):
    problem, x0 = PROBLEMS["torque arm, reach"]()
    solution = jc.solve(problem, jc.DDP(), x0)
    assert solution.us.dtype == jnp.float32 and solution.status.ok
    with jax.enable_x64(True):
        problem, x0 = PROBLEMS["torque arm, reach"]()
        wanted = jc.solve(problem, jc.DDP(), x0).cost
    np.testing.assert_allclose(solution.cost, wanted, rtol=1e-3)


def test_textbook_ddp_begins_with_the_newton_step():
    # Effort is dear enough for the exact model to be convex; it is not Gauss and Newton's.
    plant = jc.FunctionPlant(
        lambda x, u, t: x + 0.1 * (-x + u * (1 + x**2)), nx=1, nu=1, discrete=True
    )
    problem = jc.Problem(plant, jc.QuadraticCost(R=3.0, Qf=2.0, target=2.0), num_steps=15)
    x0, us = jnp.array([0.3]), problem.nominal_controls
    xs = problem.rollout(x0, us)
    model = jc.expand(problem, xs, us, second_order=True)
    law = jc.linear.lqr(model)
    assert law.ok  # convex as it is: no damping

    x, newton = x0, []
    for i, t in enumerate(problem.ts[:-1]):
        newton.append(us[i] + law.k[i] + law.K[i] @ (x - xs[i]))
        x = problem.step(x, newton[-1], t)
    newton = jnp.stack(newton)
    first = jc.solve(problem, jc.DDP(start="exact"), x0, max_steps=1)
    assert first.history.step[1] == 1
    np.testing.assert_allclose(first.us, newton, rtol=1e-9, atol=1e-9)
    ours = jc.solve(problem, jc.DDP(), x0, max_steps=1)
    assert float(jnp.abs(ours.us - newton).max()) > 1e-3 * float(jnp.abs(newton).max())


@pytest.mark.parametrize("name", ["torque arm, reach", "muscle arm, reach"])
def test_textbook_ddp_comes_to_the_same_optimum_by_damping_alone(name):
    problem, x0 = PROBLEMS[name]()
    textbook, ours = (jc.solve(problem, jc.DDP(start=s), x0) for s in ("exact", "gauss-newton"))
    assert textbook.status.ok, textbook.status.message
    np.testing.assert_allclose(textbook.cost, ours.cost, rtol=1e-8)
    # The exact model is not convex at the start: what ILQR steps by at once is damped first.
    assert ours.history.step[1] > 0 and textbook.history.step[1] == 0
    assert textbook.history.lam[2] > 0
    assert textbook.num_steps > 2 * ours.num_steps


def test_an_unknown_start_is_refused():
    with pytest.raises(ValueError, match='start: "gauss-newton" or "exact" is wanted, got \'newt'):
        jc.DDP(start="newton")  # pyright: ignore[reportArgumentType]
