"""What a converged status implies, on every kind of problem that the package builds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS, gradient

import jaxctrl as jc


@pytest.mark.parametrize("name", PROBLEMS)
def test_converged_implies_finite_arrays_the_reported_cost_and_a_small_gradient(name):
    problem, x0 = PROBLEMS[name]()
    solver = jc.ILQR()
    solution = jc.solve(problem, solver, x0)
    assert solution.status.ok, str(solution)
    for leaf in jax.tree.leaves((solution.xs, solution.us, solution.policy.K, solution.cost)):
        assert jnp.isfinite(leaf).all()
    # The roll-out and the cost once more, step by step and outside the solver.
    x, total, dt = x0, 0.0, problem.rate
    step = jax.jit(lambda x, u, t: problem.step(x, u, t))
    running = jax.jit(lambda problem, x, u, t: problem.running(x, u, t))
    for k, u in enumerate(solution.us):
        np.testing.assert_allclose(solution.xs[k], x, rtol=1e-9, atol=1e-11)
        total += dt * running(problem, x, u, problem.ts[k])
        x = step(x, u, problem.ts[k])
    total += problem.end(x)
    for times, value, _ in problem.terms.events:
        for i, time in enumerate(times):
            at = [np.interp(time, problem.ts, column) for column in np.asarray(solution.xs).T]
            total += value(problem.plant, jnp.array(at), i)
    np.testing.assert_allclose(solution.cost, total, rtol=1e-10)
    # The gradient by reverse mode, in the solver's measure with curvatures of its own sweep.
    g = gradient(problem, x0, solution.us)
    tolerance = solver.tolerances.resolve(g.dtype)[0]
    assert solution.gradient <= tolerance
    model = jc.expand(problem, solution.xs, solution.us)
    D = jc.linear.lqr(model).curvature
    down = solution.us - g / D
    if problem.bounds is not None:
        down = jnp.clip(down, *problem.bounds)
        assert (solution.us >= problem.bounds[0]).all() and (solution.us <= problem.bounds[1]).all()
    measure = jnp.sqrt(jnp.sum(D * (solution.us - down) ** 2) / solution.cost)
    # With bounds the curvatures of the free sweep are a little smaller than the boxed one's.
    assert measure <= 10 * tolerance


@pytest.mark.parametrize("name", PROBLEMS)
def test_float32_reaches_the_float64_cost(name, float32):
    with jax.enable_x64(True):
        problem, x0 = PROBLEMS[name]()
        wanted = float(jc.solve(problem, jc.ILQR(), x0).cost)
    problem, x0 = PROBLEMS[name]()
    assert x0.dtype == jnp.float32
    solution = jc.solve(problem, jc.ILQR(), x0)
    assert solution.status.ok, str(solution)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves((solution.xs, solution.us)))
    if solution.cost < 0.999 * wanted:  # another optimum, and a better one: float64's own, then
        with jax.enable_x64(True):
            problem, x0 = PROBLEMS[name]()
            us = np.asarray(solution.us, float)
            wanted = float(jc.solve(problem, jc.ILQR(), x0, us).cost)
    np.testing.assert_allclose(solution.cost, wanted, rtol=1e-3)
