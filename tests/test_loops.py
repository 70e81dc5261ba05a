"""Plants and costs with a `lax.while_loop` inside, through which reverse mode does not go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl._jacobian import gradient, jacobian, reversible

X0 = jnp.array([2.0, 0.0])
PARAMS = {"friction": jnp.array(0.1), "gravity": jnp.array(9.81)}


def root(residual, start, loops):
    """Solve residual(s) = 0 for one number, by a while loop or by six rounds of Newton's method."""

    def better(s):
        value, slope = jax.jvp(residual, (s,), (jnp.ones_like(s),))
        return s - value / slope

    if not loops:
        return jax.lax.fori_loop(0, 6, lambda _, s: better(s), start)

    def off(carry):
        s, count = carry
        return (jnp.abs(residual(s)) > 1e-13) | (count < 2)

    return jax.lax.while_loop(off, lambda carry: (better(carry[0]), carry[1] + 1), (start, 0))[0]


def implicit_pendulum(loops):
    """A pendulum with cubic friction, whose velocity takes implicit Euler steps of 0.05 s."""

    def dynamics(x, u, t, p):
        push = u[0] - p["gravity"] * jnp.sin(x[0])
        speed = root(lambda v: v - x[1] - 0.05 * (push - p["friction"] * v**3), x[1], loops)
        return jnp.array([x[0] + 0.05 * speed, speed])

    return jc.FunctionPlant(dynamics, nx=2, nu=1, params=PARAMS, discrete=True)


def problem(loops, weight=5.0, **arguments):
    cost = jc.FunctionCost(
        running=lambda x, u, t, p: 0.01 * u @ u,
        terminal=lambda x, p: p * (jnp.sin(x[0]) ** 2 + 0.1 * x[1] ** 2),
        params=weight,
    )
    return jc.Problem(implicit_pendulum(loops), cost, num_steps=20, **arguments)


@pytest.fixture(scope="module", params=["ILQR", "DDP"])
def solved(request):
    """The same solve with a while loop and with a fixed number of rounds."""
    solver = getattr(jc, request.param)()
    return [jc.solve(problem(loops), solver, X0) for loops in (True, False)]


def test_a_plant_with_a_loop_is_solved_as_one_with_fixed_rounds(solved):
    loop, fixed = solved
    assert loop.status.ok and fixed.status.ok
    assert int(loop.num_steps) == int(fixed.num_steps)
    np.testing.assert_allclose(loop.cost, fixed.cost, rtol=1e-12)
    np.testing.assert_allclose(loop.us, fixed.us, atol=1e-9)
    np.testing.assert_allclose(loop.policy.K, fixed.policy.K, atol=1e-6)


def test_its_policy_runs_in_closed_loop(solved):
    loop, fixed = solved
    ends = [
        jc.simulate(problem(loops), found.policy, X0 + 0.1).xs[-1]
        for loops, found in ((True, loop), (False, fixed))
    ]
    np.testing.assert_allclose(*ends, atol=1e-8)


def test_bounds_hold_and_a_limit_is_a_status():
    bounded = jc.solve(problem(True, control_bounds=(-2.0, 2.0)), jc.ILQR(), X0)
    assert bounded.status.ok and jnp.abs(bounded.us).max() == 2.0
    unfinished = jc.solve(problem(True), jc.ILQR(), X0, max_steps=1)
    assert unfinished.status.name in ("MAX_STEPS", "NEARLY_CONVERGED")


def test_derivatives_of_its_solve_are_those_of_fixed_rounds():
    def cost(problem, x0):
        return jc.solve(problem, jc.ILQR(), x0).cost

    def weighed(weight, x0):
        return cost(problem(True, weight), x0)

    wanted = jax.jit(jax.grad(cost, (0, 1)))(problem(False), X0)
    # Forward with respect to everything.
    given = (problem(True), X0)
    push = jax.jit(lambda given, tangents: jax.jvp(cost, given, tangents)[1])
    forward = push(given, jax.tree.map(jnp.ones_like, given))
    total = sum(float(jnp.sum(leaf)) for leaf in jax.tree.leaves(wanted))
    np.testing.assert_allclose(forward, total, rtol=1e-6)
    # Reverse with respect to what does not pass the loop.
    weight, x0 = jax.jit(jax.grad(weighed, (0, 1)))(jnp.array(5.0), X0)
    np.testing.assert_allclose(weight, wanted[0].cost.params, rtol=1e-6)
    np.testing.assert_allclose(x0, wanted[1], rtol=1e-6)


@pytest.mark.parametrize("batched", [False, True])
def test_reverse_derivatives_through_the_loop_say_what_is_missing(batched):
    def cost(problem):
        solve = lambda x: jc.solve(problem, jc.ILQR(), x).cost  # noqa: E731
        return jax.vmap(solve)(jnp.stack([X0, 0.5 * X0])).sum() if batched else solve(X0)

    with pytest.raises(RuntimeError, match=r"does not go through a lax.while_loop.*jax.jvp"):
        jax.eval_shape(jax.grad(cost), problem(True))


def test_gains_are_differentiated_forward_alone():
    def gains(x0):
        return jc.solve(problem(True), jc.ILQR(), x0).policy.K

    jax.eval_shape(jax.jacfwd(gains), X0)
    with pytest.raises(RuntimeError, match=r"does not go through a lax.while_loop.*jax.jvp"):
        jax.eval_shape(jax.jacrev(gains), X0)


@pytest.mark.parametrize("solver", [jc.LBFGS(), jc.ConjugateGradient()])
def test_solvers_by_reverse_mode_refuse_it(solver):
    with pytest.raises(ValueError, match=r"through a lax.while_loop.*ILQR and DDP do without"):
        jc.solve(problem(True), solver, X0)


def reach(loops):
    """A rod on a cam: how far its hand is, and so the cost, comes from a loop."""

    def hand(x):
        return root(lambda c: c**2 - 0.25 * (1 + jnp.sin(x[0])) ** 2 - 0.1, 1 + x[0], loops)

    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    cost = jc.FunctionCost(
        running=lambda x, u, t: 0.1 * u @ u + 0.1 * hand(x) ** 2,
        terminal=lambda x: 10 * (hand(x) - 0.8) ** 2 + x[1] ** 2,
        event=lambda x, i: hand(x) ** 2,
        event_times=jnp.array([0.33]),
    )
    return jc.Problem(plant, cost, num_steps=20, dt=0.05)


def test_a_cost_with_a_loop_is_solved_as_one_with_fixed_rounds():
    x0 = jnp.array([0.2, 0.0])
    loop, fixed = (jc.solve(reach(loops), jc.DDP(), x0) for loops in (True, False))
    assert loop.status.ok
    np.testing.assert_allclose(loop.cost, fixed.cost, rtol=1e-10)
    np.testing.assert_allclose(loop.us, fixed.us, atol=1e-7)


def test_a_loop_that_derivatives_pass_by_keeps_reverse_mode():
    def stopped(x):
        rounds = jax.lax.while_loop(lambda c: c < jax.lax.stop_gradient(x[0]), lambda c: c + 1, 0.0)
        return rounds * x

    def solved(x):  # conjugate gradients, with a transposed solve of their own
        return jax.scipy.sparse.linalg.cg(lambda v: 2 * v, x)[0]

    def looped(x):
        return jax.lax.while_loop(lambda c: c[0] < 3, lambda c: c + x[1], x)

    x = jnp.array([0.7, 0.4, 1.3])
    assert reversible(stopped, x) and reversible(solved, x) and not reversible(looped, x)
    for function in (stopped, solved, looped):
        np.testing.assert_allclose(jacobian(function)(x), jax.jacfwd(function)(x), atol=1e-12)
        value = lambda x, f=function: jnp.sum(f(x) ** 2)  # noqa: E731
        np.testing.assert_allclose(gradient(value)(x), jax.jacfwd(value)(x), atol=1e-12)


@pytest.mark.slow
def test_collocation_goes_forward_through_a_loop():
    def plant(loops):
        def dynamics(x, u, t):
            return jnp.array([x[1], u[0] - root(lambda s: s - jnp.sin(x[0]), x[0], loops)])

        return jc.FunctionPlant(dynamics, nx=2, nu=1)

    cost = jc.QuadraticCost(Q=1.0, R=0.1, Qf=1.0)
    loop, fixed = (
        jc.solve(jc.Problem(plant(loops), cost, num_steps=20, dt=0.05), jc.BoundaryValue(), X0)
        for loops in (True, False)
    )
    assert loop.status.ok
    np.testing.assert_allclose(loop.us, fixed.us, atol=1e-8)
