"""Conjugate gradients and L-BFGS: SciPy's optima and ILQR's, in ILQR's measure of success."""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from problems import PROBLEMS, gradient, with_bounds

import jaxctrl as jc
from jaxctrl.solvers._descent import Point

SOLVERS = [jc.ConjugateGradient(), jc.LBFGS()]


def each(quick):
    """Run a test with both solvers, all but the quick one only in the slow suite."""
    return pytest.mark.parametrize(
        "solver",
        [
            pytest.param(s, id=type(s).__name__, marks=[] if s == quick else pytest.mark.slow)
            for s in SOLVERS
        ],
    )


X0 = jnp.array([2.5, 0.0])


def pendulum(x, u, t, p):
    return jnp.array([x[1], 9.8 * jnp.sin(x[0]) - p * x[1] + u[0]])


def swing(dynamics=pendulum, cost=None, **arguments):
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=0.01)
    cost = jc.QuadraticCost(R=1e-3, Qf=1.0) if cost is None else cost
    return jc.Problem(plant, cost, num_steps=30, dt=0.05, **arguments)


def pair(bounds=None):
    """Two coupled masses pushed by forces in different units, with a price on everything."""

    def dynamics(x, u, t):
        return jnp.array([x[2], x[3], u[0] - x[0] + 0.5 * x[1], 1e-3 * u[1] - x[1] + 0.5 * x[0]])

    plant = jc.FunctionPlant(dynamics, nx=4, nu=2)
    cost = jc.QuadraticCost(Q=1.0, R=jnp.array([0.1, 1e-7]), Qf=10.0)
    problem = jc.Problem(plant, cost, num_steps=20, dt=0.1)
    return problem if bounds is None else with_bounds(problem, bounds)


X4 = jnp.array([1.0, -1.0, 0.0, 0.5])


def quadratic(problem, x0):
    """Return the dense Hessian and gradient at zero of the cost in all controls."""
    shape = (problem.num_steps, problem.plant.nu)

    def cost(us):
        us = us.reshape(shape)
        return problem.total_cost(problem.rollout(x0, us), us)

    zero = jnp.zeros(shape[0] * shape[1])
    return jax.hessian(cost)(zero), jax.grad(cost)(zero)


def falls(solution):
    """Tell whether the cost never rises by more than rounding."""
    cost = np.asarray(solution.history.cost)[: int(solution.num_steps) + 1]
    return np.isfinite(cost).all() and (np.diff(cost) <= 4e-11 * np.abs(cost[1:])).all()


@each(SOLVERS[0])
def test_linear_quadratic_problem_equals_the_dense_solution(solver):
    problem = pair()
    H, g = quadratic(problem, X4)
    solution = jc.solve(problem, solver, X4)
    assert solution.status.ok, str(solution)
    wanted = -jnp.linalg.solve(H, g).reshape(solution.us.shape)
    size = jnp.abs(wanted).max(axis=0)
    np.testing.assert_allclose(solution.us / size, wanted / size, atol=1e-4)
    ilqr = jc.solve(problem, jc.ILQR(), X4)
    np.testing.assert_allclose(solution.cost, ilqr.cost, rtol=1e-9)
    np.testing.assert_allclose(solution.policy.K, ilqr.policy.K, rtol=1e-8, atol=1e-10)


@each(SOLVERS[1])
def test_bounded_quadratic_satisfies_its_optimality_conditions(solver):
    lower, upper = jnp.array([-0.9, -1000.0]), jnp.array([0.9, 500.0])
    problem = pair((lower, upper))
    H, g = quadratic(problem, X4)
    solution = jc.solve(problem, solver, X4)
    assert solution.status.ok, str(solution)
    us = solution.us
    assert (us >= lower).all() and (us <= upper).all()
    at_lower, at_upper = us == lower, us == upper
    assert 3 < (at_lower | at_upper).sum() < us.size - 3
    # The multipliers' signs, and the dense solution in the controls that are free.
    slope = (H @ us.ravel() + g).reshape(us.shape)
    assert (slope[at_lower] > 0).all() and (slope[at_upper] < 0).all()
    free = np.flatnonzero(~np.asarray(at_lower | at_upper))
    held = jnp.where(at_lower | at_upper, us, 0.0).ravel()
    inner = -jnp.linalg.solve(H[np.ix_(free, free)], (g + H @ held)[free])
    size = jnp.broadcast_to(upper - lower, us.shape).ravel()[free]
    np.testing.assert_allclose(us.ravel()[free] / size, inner / size, atol=1e-4)


def small():
    """A quadratic of six controls: its problem, start, Hessian and gradient at zero."""
    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    problem = jc.Problem(plant, jc.QuadraticCost(Q=1.0, R=10.0, Qf=10.0), num_steps=6, dt=0.5)
    x0 = jnp.array([1.0, 0.0])
    return problem, x0, *quadratic(problem, x0)


def test_directions_with_exact_steps_are_those_of_linear_conjugate_gradients():
    H, g = map(np.asarray, small()[2:])
    solver, metric = jc.ConjugateGradient(), jnp.array([3.0])
    us, theirs, r, z, before = np.zeros(6), np.zeros(6), g, np.zeros(6), 1.0
    memory, fresh = solver._begin(jnp.zeros((6, 1))), True
    for _ in range(6):
        free, one = jnp.full((6, 1), True), jnp.array(1.0)
        point = Point(jnp.array(us)[:, None], jnp.array(g + H @ us)[:, None], metric, free, one)
        state: Any = SimpleNamespace(
            memory=memory, fresh=jnp.array(fresh), predicted=jnp.array(0.0)
        )
        d, _, memory = solver._direction(point, state)
        d, fresh = np.asarray(d)[:, 0], False
        us = us - (d @ (g + H @ us)) / (d @ H @ d) * d
        # Hestenes and Stiefel (1952), by residuals alone.
        z = (r @ r) / before * z - r
        step = (r @ r) / (z @ H @ z)
        before = r @ r
        theirs, r = theirs + step * z, r + step * (H @ z)
        np.testing.assert_allclose(us, theirs, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(us, -jnp.linalg.solve(H, g), rtol=1e-8)


def test_conjugate_gradients_end_a_quadratic_in_about_as_many_steps_as_it_has_controls():
    problem, x0, H, g = small()
    solution = jc.solve(problem, jc.ConjugateGradient(gradient_tolerance=1e-8), x0)
    assert solution.status.ok and solution.num_steps <= 2 * 6, str(solution)
    np.testing.assert_allclose(solution.us[:, 0], -jnp.linalg.solve(H, g), rtol=1e-6)


def scipy_cost(problem, x0, method):
    """Return the least cost that SciPy finds from the nominal controls."""
    start = problem.nominal_controls

    @jax.jit
    @jax.value_and_grad
    def cost(us):
        us = us.reshape(start.shape)
        return problem.total_cost(problem.rollout(x0, us), us)

    scale = 1 / float(cost(start.ravel())[0])
    bounds = None if problem.bounds is None else [*zip(*map(np.ravel, problem.bounds), strict=True)]
    options = {"maxiter": 2000, "gtol": 1e-9}
    if method == "L-BFGS-B":
        options |= {"ftol": 1e-15, "maxfun": 10000}
    found = scipy.optimize.minimize(
        lambda us: tuple(scale * np.asarray(part) for part in cost(us)),
        np.ravel(start), jac=True, method=method, bounds=bounds, options=options,
    )  # fmt: skip
    return found.fun / scale


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    [("pendulum", "CG"), ("torque arm, posture", "CG"), ("torque arm, reach, bounded", "L-BFGS-B")],
)
def test_costs_equal_those_of_ilqr_and_of_scipy(name, method):
    problem, x0 = PROBLEMS[name]()
    best = float(jc.solve(problem, jc.DDP(), x0).cost)
    theirs = scipy_cost(problem, x0, method)
    for solver in SOLVERS:
        solution = jc.solve(problem, solver, x0, max_steps=3000)
        print(name, type(solver).__name__, solution, "SciPy", theirs / best - 1, sep="\n")
        assert solution.status.ok, str(solution)
        np.testing.assert_allclose(solution.cost, best, rtol=1e-6)
        assert solution.cost <= theirs * (1 + 1e-6)
        assert falls(solution)
        # The measure of success, from a gradient and a sweep of our own.
        us = solution.us
        model = jc.expand(problem, solution.xs, us)
        D, down = jc.linear.lqr(model).curvature, gradient(problem, x0, us)
        down = us - down / D
        if problem.bounds is not None:
            lower, upper = problem.bounds
            assert (us >= lower).all() and (us <= upper).all()
            assert ((us == lower) | (us == upper)).sum() > 10
            down = jnp.clip(down, lower, upper)
        measure = jnp.sqrt(jnp.sum(D * (us - down) ** 2) / solution.cost)
        assert measure <= 10 * jc.ILQR().tolerances.resolve(us.dtype)[0]


@each(SOLVERS[0])
def test_success_means_the_same_as_that_of_ilqr(solver):
    solution = jc.solve(swing(control_bounds=(-4.0, 4.0)), solver, X0)
    ilqr = jc.solve(swing(control_bounds=(-4.0, 4.0)), jc.ILQR(), X0, solution.us)
    assert solution.status.ok and ilqr.status.ok and int(ilqr.num_steps) <= 1
    np.testing.assert_allclose(ilqr.history.gradient[0], solution.gradient, rtol=1e-3)
    policy = solution.policy
    np.testing.assert_array_equal(policy.k, 0.0)
    trajectory = jc.simulate(swing(control_bounds=(-4.0, 4.0)), policy, X0)
    np.testing.assert_allclose(trajectory.xs, solution.xs, atol=1e-12)


@pytest.mark.slow
@each(SOLVERS[1])
def test_units_of_cost_and_controls_do_not_matter(solver):
    plain = jc.solve(pair(), solver, X4)
    # Powers of two: a quadratic is interpolated by cubics, whose rounding is amplified.
    c = 2.0**20
    scaled = jc.Problem(
        jc.FunctionPlant(
            lambda x, u, t: pair().plant(x, u * jnp.array([1.0, 2.0**13]), t), nx=4, nu=2
        ),
        jc.QuadraticCost(Q=c, R=c * jnp.array([0.1, 1e-7 * 2.0**26]), Qf=10 * c),
        num_steps=20, dt=0.1,
    )  # fmt: skip
    other = jc.solve(scaled, solver, X4)
    assert plain.status.ok and other.status.ok
    np.testing.assert_allclose(other.history.cost[:6], c * plain.history.cost[:6], rtol=1e-9)
    np.testing.assert_allclose(other.cost, c * plain.cost, rtol=1e-8)


@each(SOLVERS[1])
def test_jit_vmap_and_repetition_give_the_same_and_a_bad_lane_is_flagged_alone(solver):
    problem = swing(control_bounds=(-6.0, 6.0))
    starts = jnp.stack([X0, X0.at[0].set(jnp.nan), jnp.array([1.0, 0.5])])
    batch = jax.jit(jax.vmap(lambda x: jc.solve(problem, solver, x)))(starts)
    np.testing.assert_array_equal(np.asarray(batch.status.ok), [True, False, True])
    assert int(batch.status.code[1]) == jc.Reason.NONFINITE_INPUT
    for lane in (0, 2):
        solo = jc.solve(problem, solver, starts[lane])
        np.testing.assert_allclose(batch.cost[lane], solo.cost, rtol=1e-8)
        np.testing.assert_allclose(batch.us[lane], solo.us, atol=1e-3)
    again, jitted = jc.solve(problem, solver, X0), jax.jit(lambda x: jc.solve(problem, solver, x))
    first = jc.solve(problem, solver, X0)
    jax.tree.map(np.testing.assert_array_equal, again, first)
    np.testing.assert_allclose(jitted(X0).cost, first.cost, rtol=1e-9)
    lanes = jc.solve_batch(problem, solver, starts[::2])
    np.testing.assert_allclose(lanes.cost, batch.cost[::2], rtol=1e-8)


@each(SOLVERS[1])
def test_derivatives_of_the_optimal_cost_are_those_of_ilqr(solver):
    def slopes(solver):
        found = jax.grad(lambda x0: jc.solve(swing(), solver, x0).cost)(X0)
        return found, eqx.filter_grad(lambda p: jc.solve(p, solver, X0).cost)(swing()).plant.params

    for mine, theirs in zip(slopes(solver), slopes(jc.ILQR()), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4)


@each(SOLVERS[0])
def test_trials_that_overflow_or_leave_the_domain_are_rejected(solver):
    def barrier(x, u, t):
        return 1e-3 * u[0] ** 2 - 1e-1 * jnp.log(1.2 + x[1] / 3.0)

    cost = jc.FunctionCost(running=barrier, terminal=lambda x: 20 * jnp.sum(x**2))
    edge = jc.solve(swing(cost=cost), solver, X0, max_steps=2000)
    assert edge.status.ok and jnp.isfinite(edge.xs).all() and falls(edge), str(edge)
    ilqr = jc.solve(swing(cost=cost), jc.ILQR(), X0)
    np.testing.assert_allclose(edge.cost, ilqr.cost, rtol=1e-6)

    def explosive(x, u, t, p):
        return jnp.array([x[1], x[0] ** 3 + u[0]])

    cost = jc.QuadraticCost(R=1e-8, Qf=1e3)
    start = jnp.array([1.0, 0.3])
    burst = jc.solve(swing(explosive, cost), solver, start, -jnp.ones((30, 1)), max_steps=20)
    assert falls(burst) and jnp.isfinite(burst.xs).all()
    assert burst.cost < 0.5 * burst.history.cost[0]


@each(SOLVERS[1])
def test_every_end_has_its_status(solver):
    def name(*arguments, **options):
        return jc.solve(*arguments, **options).status.name

    assert name(swing(), solver, X0, max_steps=0) == "MAX_STEPS"
    full = jc.solve(swing(), solver, X0)
    last = int(full.num_steps) - 1
    assert name(swing(), solver, X0, max_steps=last) == "NEARLY_CONVERGED"
    assert jc.solve(swing(), jc.ILQR(), X0, full.us).num_steps <= 1
    assert int(jc.solve(swing(), solver, X0, full.us).num_steps) == 0
    broken = jax.jit(lambda lower: jc.solve(swing(control_bounds=(lower, 1.0)), solver, X0))
    assert broken(2.0).status.name == "INFEASIBLE_BOUNDS"
    nan = jc.FunctionCost(
        running=lambda x, u, t: jnp.where(t > 0.49, jnp.sqrt(-1.0 - t), u[0] ** 2)
    )
    bad = jc.solve(swing(cost=nan), solver, X0).status
    assert bad.name == "NONFINITE_COST" and int(bad.index) == 10
    kink = jc.FunctionCost(running=lambda x, u, t: jnp.sqrt(u[0] ** 2) + u[0] ** 2)
    assert name(swing(cost=kink), solver, X0) == "NONFINITE_DERIVATIVE"
    with pytest.raises(ValueError, match="memory: at least 1 is wanted, got 0"):
        jc.LBFGS(memory=0)
    # What lies below the costs' own round-off cannot be reached, and is not claimed.
    tight = type(solver)(gradient_tolerance=1e-12)
    end = jc.solve(swing(), tight, X0, max_steps=2000)
    assert end.status.ok == (end.gradient <= 1e-12)
    assert end.status.ok or end.status.name in ("STALLED", "LINE_SEARCH_FAILED"), str(end)


@each(SOLVERS[0])
def test_equal_bounds_fix_the_controls(solver):
    solution = jc.solve(swing(control_bounds=(0.7, 0.7)), solver, X0)
    np.testing.assert_array_equal(solution.us, 0.7)
    assert solution.status.ok


@each(SOLVERS[0])
def test_float32_reaches_the_float64_cost(solver, float32):
    solution = jc.solve(swing(), solver, jnp.array([2.5, 0.0], jnp.float32))
    assert solution.us.dtype == jnp.float32
    # Whether its search or its gradient ends it is for rounding to choose: compilers differ.
    lost = solution.status.is_(jc.Reason.LINE_SEARCH_FAILED) & (solution.gradient < 0.1)
    assert solution.status.ok | lost, str(solution)
    with jax.enable_x64(True):
        wanted = jc.solve(swing(), jc.ILQR(), jnp.array([2.5, 0.0])).cost
    np.testing.assert_allclose(solution.cost, wanted, rtol=1e-3)


@each(jc.LBFGS())
def test_the_first_step_does_not_leap_out_of_the_basin(solver):
    # The curvature at the start is a thousandth of the slope: its step would end near x = -900,
    # where the cost is lower than at the start, but flat.
    def terminal(x):
        s = jnp.sqrt(x[0] ** 2 + 1e-3)
        return s * jax.nn.sigmoid(20 - s) + 0.5 * (1 - jnp.exp(-((x[0] / 100) ** 2)))

    plant = jc.FunctionPlant(lambda x, u, t: x + u, nx=1, nu=1, discrete=True)
    problem = jc.Problem(plant, jc.FunctionCost(terminal=terminal), num_steps=1)
    solution = jc.solve(problem, solver, jnp.ones(1))
    assert solution.status.ok and abs(float(solution.xs[-1, 0])) < 1e-4
