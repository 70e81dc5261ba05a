"""Pontryagin's boundary-value problem against closed forms, brute force and the other solvers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_bvp

import jaxctrl as jc
from jaxctrl.solvers import _collocation
from jaxctrl.solvers._collocation import Path, _System, collocate
from jaxctrl.solvers._hamiltonian import Hamiltonian

Q, R, QF = 2.0, 0.3, 5.0
A, B = np.array([[0.0, 1.0], [-0.5, 0.0]]), np.array([[0.0], [1.0]])
X0 = jnp.array([1.0, 0.5])
RUNGE_KUTTA = jc.RK4()


def oscillator(x, u, t):
    return jnp.stack([x[1], -0.5 * x[0] + u[0]])


def linear(bounds=None, cost=None):
    plant = jc.FunctionPlant(oscillator, nx=2, nu=1)
    cost = jc.QuadraticCost(Q=Q, R=R, Qf=QF) if cost is None else cost
    return jc.Problem(
        plant, cost, num_steps=200, dt=0.01, control_bounds=bounds, integrator=RUNGE_KUTTA
    )


def pendulum(num_steps=200, duration=1.0, effort=1e-2, integrator=RUNGE_KUTTA):
    return jc.Problem(
        jc.plants.Pendulum(), jc.QuadraticCost(R=effort, Qf=1.0), num_steps=num_steps,
        dt=duration / num_steps, integrator=integrator,
    )  # fmt: skip


def closed_form():
    """Return the Hamiltonian system's matrix and the costate at the start."""
    M = np.block([[A, -B @ B.T / R], [-Q * np.eye(2), -A.T]])
    E = scipy.linalg.expm(2.0 * M)
    # p(T) = QF x(T) with (x, p)(T) = E (x0, p0).
    left = E[2:, 2:] - QF * E[:2, 2:]
    return M, np.linalg.solve(left, (QF * E[:2, :2] - E[2:, :2]) @ np.asarray(X0))


def test_linear_quadratic_extremal_is_the_matrix_exponential_s():
    problem = linear()
    s = np.linspace(0, 1, 21)
    guess = np.concatenate([np.tile(X0, (21, 1)), np.zeros((21, 2))], axis=1)
    path = Path(s, guess, lambda at: guess[: len(at)])
    found = collocate(Hamiltonian(problem, jnp.zeros(1)), np.asarray(X0), path, 1e-8, 5000)
    assert found.reason is jc.Reason.RUNNING
    M, p0 = closed_form()
    start = np.concatenate([X0, p0])
    at = np.linspace(0, 1, 37)
    wanted = np.stack([scipy.linalg.expm(2.0 * v * M) @ start for v in at])
    np.testing.assert_allclose(found.path.at(at), wanted, atol=1e-7)


def test_linear_quadratic_cost_and_controls_are_the_closed_form_s():
    problem = linear()
    solution = jc.solve(problem, jc.BoundaryValue(), X0)
    M, p0 = closed_form()
    assert solution.status.name == "CONVERGED_COLLOCATION" and solution.status.ok
    # J = x0'P x0/2 = x0'p0/2; the running cost is summed at the beginnings of steps, to O(dt).
    np.testing.assert_allclose(solution.cost, jc.solve(problem, jc.DDP(), X0).cost, rtol=1e-4)
    np.testing.assert_allclose(solution.cost, 0.5 * X0 @ p0, rtol=2e-2)
    middle = (np.arange(200) + 0.5) / 200
    start = np.concatenate([X0, p0])
    wanted = [-(scipy.linalg.expm(2.0 * v * M) @ start)[3] / R for v in middle]
    np.testing.assert_allclose(solution.us[:, 0], wanted, atol=0.02)


def test_saturated_controls_are_those_of_ddp_on_a_fine_grid():
    problem = linear(bounds=(-0.6, 0.4))
    solution = jc.solve(problem, jc.BoundaryValue(), X0, throw=True)
    other = jc.solve(problem, jc.DDP(), X0, throw=True)
    np.testing.assert_allclose(solution.cost, other.cost, rtol=1e-4)
    np.testing.assert_allclose(solution.us, other.us, atol=0.02)
    assert (solution.us == -0.6).sum() > 25 and solution.us.max() <= 0.4


@pytest.mark.slow
def test_gap_to_the_grid_s_optimum_falls_with_the_square_of_the_step():
    """The controls differ by O(dt), and a cost by the square of the distance to its minimum."""
    x0, gaps, costs = jnp.array([1.0, 0.0]), [], []
    for num_steps in (50, 100, 200):
        problem = pendulum(num_steps, integrator=jc.Euler())
        solution = jc.solve(problem, jc.BoundaryValue(tol=1e-6), x0, throw=True)
        best = jc.solve(problem, jc.ILQR(), x0, throw=True).cost
        gaps.append(float(solution.cost - best))
        costs.append(float(best))
    assert min(gaps) > 0
    ratios = np.array(gaps[:-1]) / np.array(gaps[1:])
    assert (ratios > 3.2).all() and (ratios < 4.5).all(), ratios
    # The grid's optimum itself is of first order.
    change = np.diff(costs)
    np.testing.assert_allclose(change[:-1] / change[1:], 2.0, rtol=0.2)


def test_swing_up_from_no_torque_finds_ddp_s_optimum_by_continuation():
    problem, x0 = pendulum(duration=4.0, effort=1e-5), jnp.array([jnp.pi, 0.0])
    solution = jc.solve(problem, jc.BoundaryValue(), x0)
    other = jc.solve(problem, jc.DDP(), x0, throw=True)
    assert solution.status.ok
    np.testing.assert_allclose(solution.cost, other.cost, rtol=1e-5)


def test_solution_is_a_roll_out_with_its_own_cost_and_gains():
    problem, x0 = pendulum(), jnp.array([1.0, 0.0])
    solution = jc.solve(problem, jc.BoundaryValue(), x0, max_steps=1)
    xs = problem.rollout(x0, solution.us)
    np.testing.assert_allclose(solution.xs, xs, atol=1e-12)
    np.testing.assert_allclose(solution.cost, problem.total_cost(xs, solution.us), rtol=1e-12)
    assert solution.gradient > jc.Tolerances().resolve(jnp.float64)[0]
    assert solution.history.cost.shape == (1,) and int(solution.num_steps) > 1
    played = jc.simulate(problem, solution.policy, x0)
    np.testing.assert_allclose(played.xs, solution.xs, atol=1e-12)
    moved = jc.simulate(problem, solution.policy, x0 + 0.05)
    unmoved = problem.rollout(x0 + 0.05, solution.us)
    assert problem.total_cost(moved.xs, moved.us) < problem.total_cost(unmoved, solution.us)


def test_hamiltonian_of_the_muscle_arm_is_minimised_beside_brute_force():
    arm, r, n = jc.plants.MuscleArm(), 1e-4, 400
    hamiltonian = Hamiltonian(jc.tasks.posture(arm, [1.0, 1.5], effort=r), jnp.zeros(6))
    rng = np.random.default_rng(0)
    q, dq = rng.uniform(0.3, 2.0, (n, 2)), rng.uniform(-5, 5, (n, 2))
    a = rng.uniform(0, 1, (n, 6))
    p = 1e-4 * np.concatenate([rng.normal(size=(n, 4)), rng.uniform(-0.08, 0.02, (n, 6))], axis=1)
    # A quarter near the switch, where both branches have nearly the same least value.
    near = n // 4
    p[:near, 4:] = -r * 0.066 * a[:near] * rng.uniform(0.85, 1.0, (near, 6))
    x = np.concatenate([q, dq, a], axis=1)
    u, fine = jax.jit(jax.vmap(hamiltonian.minimiser))(x, p, np.zeros(n))
    u = np.asarray(u)
    assert fine.all() and (u >= 0).all() and (u <= 1).all()

    def parts(u):
        time = np.where(u > a, 0.066 - 0.016 * u, 0.066)
        return r * u**2 / 2 + p[:, 4:] * (u - a) / time

    best = np.min([parts(np.full((n, 6), level)) for level in np.linspace(0, 1, 2001)], axis=0)
    assert (parts(u) <= best + 1e-12 * r).all()
    kinds = (u == 0), (u == 1), (u > a) & (u < 1), (u < a) & (u > 0)
    assert min(kind.sum() for kind in kinds) > 100


def test_coupled_and_nonaffine_controls_are_minimised_beside_brute_force():
    """A quadratic with a full Hessian in a box, and a quartic with two minima for each control."""
    W = np.array([[1.0, 0.8], [0.8, 1.0]])
    plant = jc.FunctionPlant(lambda x, u, t: u + 0.1 * x, nx=2, nu=2, control_bounds=(-1.0, 0.5))
    coupled = jc.FunctionCost(running=lambda x, u, t: 0.5 * u @ W @ u)
    double = jc.FunctionCost(running=lambda x, u, t: jnp.sum((u**2 - 0.2) ** 2))
    rng = np.random.default_rng(1)
    x, p = rng.normal(size=(60, 2)), rng.normal(size=(60, 2)) * 0.5
    levels = np.stack(np.meshgrid(*[np.linspace(-1.0, 0.5, 301)] * 2), -1).reshape(-1, 2)
    for cost in (coupled, double):
        hamiltonian = Hamiltonian(jc.Problem(plant, cost, num_steps=2), jnp.zeros(2))
        u, fine = jax.jit(jax.vmap(hamiltonian.minimiser))(x, p, np.zeros(60))
        value = jax.vmap(hamiltonian.value)
        grid = jax.vmap(jax.vmap(hamiltonian.value, (None, 0, None, None)), (0, None, 0, 0))
        least = value(x, u, p, np.zeros(60))
        assert fine.all() and (least <= grid(x, levels, p, np.zeros(60)).min(axis=1) + 1e-9).all()


def muscle_like():
    """A mass pulled by a muscle whose time constant depends on the control, and a torque."""

    def dynamics(x, u, t):
        time = jnp.where(u[0] > x[2], 0.066 - 0.016 * u[0], 0.066)
        pull = jnp.sin(x[0]) * x[2] - 0.3 * x[1] + u[1] + 0.2 * jnp.cos(3 * t)
        return jnp.stack([x[1], pull, (u[0] - x[2]) / time])

    cost = jc.FunctionCost(
        running=lambda x, u, t: 0.5 * (u @ u) + 0.1 * x[0] * x[1] * x[2] + 0.1 * u[0] * x[2],
        terminal=lambda x: jnp.sum(jnp.cosh(x)),
    )
    plant = jc.FunctionPlant(dynamics, nx=3, nu=2, control_bounds=(0.0, 1.0))
    return jc.Problem(plant, cost, num_steps=20, dt=0.05)


def test_jacobians_are_differences_of_the_functions():
    system = _System(
        Hamiltonian(muscle_like(), jnp.array([0.1, 0.0])), np.array([0.1, 0.2, 0.3]),
        np.array([1.0, 2.0, 0.5, 1e-2, 1e-1, 3.0]),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    s, z = rng.uniform(size=40), rng.normal(size=(6, 40))
    z[2] = rng.uniform(0.2, 1.8, 40)
    z[5] *= 0.03
    jacobian, h = system.rates_jacobian(s, z), 1e-6
    errors = np.empty((6, 40))
    for i in range(6):
        step = h * np.eye(6)[:, [i]]
        difference = (system.rates(s, z + step) - system.rates(s, z - step)) / (2 * h)
        errors[i] = np.abs(jacobian[:, i] - difference).max(axis=0)
    # A difference across a bound or a switch says nothing; few are.
    assert (errors.max(axis=0) < 1e-6 * (1 + np.abs(jacobian).max(axis=(0, 1)))).sum() >= 38
    first, last = rng.normal(size=(2, 6))
    by_first, by_last = system.ends_jacobian(first, last)
    for i in range(6):
        step = h * np.eye(6)[i]
        for got, a, b in ((by_first, step, 0 * step), (by_last, 0 * step, step)):
            up, down = system.ends(first + a, last + b), system.ends(first - a, last - b)
            np.testing.assert_allclose(got[:, i], (up - down) / (2 * h), rtol=1e-6, atol=1e-6)


def test_too_few_nodes_is_a_status_with_finite_arrays():
    problem, x0 = pendulum(), jnp.array([2.5, 0.0])
    solution = jc.solve(problem, jc.BoundaryValue(max_nodes=6), x0)
    assert solution.status.name == "BVP_MAX_NODES" and not solution.status.ok
    assert "max_nodes" in solution.status.message
    leaves = (solution.xs, solution.us, solution.cost, solution.gradient, solution.policy.K)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert "NOT converged" in str(solution)
    with pytest.raises(jc.SolveError, match="max_nodes"):
        jc.solve(problem, jc.BoundaryValue(max_nodes=6), x0, throw=True)


def test_problem_without_an_extremal_diverges():
    # Bratu's: x'' = -e^x, x(0) = 0, x'(T) = 0 has no solution for T > 0.94 (4T^2 > 3.514).
    plant = jc.FunctionPlant(lambda x, u, t: u, nx=1, nu=1)
    cost = jc.FunctionCost(running=lambda x, u, t: 0.5 * u @ u - jnp.exp(x[0]))
    reasons = [
        jc.solve(
            jc.Problem(plant, cost, num_steps=100, dt=T / 100, integrator=RUNGE_KUTTA),
            jc.BoundaryValue(), jnp.zeros(1),
        ).status.name
        for T in (0.9, 1.0)
    ]  # fmt: skip
    assert reasons == ["CONVERGED_COLLOCATION", "BVP_DIVERGED"]


def test_singular_collocation_is_a_status_with_finite_arrays(monkeypatch):
    class Result:
        """What SciPy returns where it can factorise nothing."""

        def __init__(self, found):
            self.__dict__.update(found, status=2)

    monkeypatch.setattr(_collocation, "solve_bvp", lambda *a, **k: Result(solve_bvp(*a, **k)))
    solution = jc.solve(linear(), jc.BoundaryValue(), X0)
    assert solution.status.name == "BVP_SINGULAR" and not solution.status.ok
    assert np.isfinite(solution.xs).all() and np.isfinite(solution.us).all()


def test_hamiltonian_without_a_minimum_is_not_called_solved():
    solution = jc.solve(linear(cost=jc.QuadraticCost(Q=1.0, Qf=1.0)), jc.BoundaryValue(), X0)
    assert not solution.status.ok and np.isfinite(solution.xs).all()


def test_start_that_diverges_names_the_dynamics():
    plant = jc.FunctionPlant(lambda x, u, t: jnp.stack([x[1] ** 2, x[0] ** 3 + u[0]]), nx=2, nu=1)
    problem = jc.Problem(plant, jc.QuadraticCost(R=1.0, Qf=1.0), num_steps=30, dt=0.05)
    solution = jc.solve(problem, jc.BoundaryValue(), jnp.array([50.0, 50.0]))
    assert solution.status.name == "NONFINITE_DYNAMICS" and np.isfinite(solution.xs).all()


def test_it_says_that_it_cannot_be_traced():
    problem, solver = linear(), jc.BoundaryValue()
    for transform, x0 in ((jax.jit, X0), (jax.grad, X0), (jax.vmap, X0[None])):
        with pytest.raises(TypeError, match=r"BoundaryValue runs on the host.*ILQR or DDP"):
            transform(lambda x: jc.solve(problem, solver, x).cost)(x0)
    with pytest.raises(TypeError, match="runs on the host"):
        jax.grad(lambda p: jc.solve(p, solver, X0).cost)(problem)
    with pytest.raises(TypeError, match="runs on the host"):
        jc.solve_batch(problem, solver, jnp.stack([X0, X0]))


class Change(jc.AbstractRate, jc.AbstractResidual, jc.AbstractEnd):
    def rate(self, plant, at):
        return 0.5 * at.u @ at.u

    def end(self, plant, x):
        return x @ x

    def residual(self, plant, at):
        return (at.after - at.x) / at.dt


def test_what_has_no_boundary_value_problem_is_refused():
    event = jc.FunctionCost(event=lambda x, i: x[0] ** 2, event_times=[0.5])
    discrete = jc.FunctionPlant(lambda x, u, t: x + u, nx=2, nu=2, discrete=True)
    for problem, match in (
        (linear() + event, r"problem: .*events \(via-points\)"),
        (linear() + Change(), r"problem: .*whole steps, Change"),
        (jc.Problem(discrete, jc.QuadraticCost(R=1.0), num_steps=3), "problem: .*discrete plant"),
    ):
        with pytest.raises(ValueError, match=match):
            jc.solve(problem, jc.BoundaryValue(), X0)
    for arguments in ({"tol": 0.0}, {"tol": None}, {"max_nodes": 3}, {"max_nodes": 10.0}):
        with pytest.raises((TypeError, ValueError), match=next(iter(arguments))):
            jc.BoundaryValue(**arguments)  # pyright: ignore[reportArgumentType]


def test_noise_in_the_problem_warns_that_it_is_ignored():
    cost = jc.FunctionCost(event=lambda x, i: x[0] ** 2, event_times=[0.5])
    noisy = jc.Problem(linear().plant, cost, num_steps=100, noise=jc.AdditiveNoise(0.1))
    with (
        pytest.warns(UserWarning, match="BoundaryValue minimises the nominal cost"),
        pytest.raises(ValueError, match="via-points"),
    ):
        jc.solve(noisy, jc.BoundaryValue(), X0)


def test_controls_that_fail_on_the_grid_are_no_success():
    # Euler's steps of 10 ms are too coarse for a swing-up within 3 N m that nothing corrects.
    found = jc.problems.load("pendulum-bounded")
    solution = jc.solve(found.problem, jc.BoundaryValue(), found.x0, found.us)
    assert solution.status.name == "BVP_OFF_GRID" and not solution.status.ok
    assert solution.cost > 10 * found.optimum and "RK4" in solution.status.message
    assert float(solution.cost) == pytest.approx(
        float(found.problem.total_cost(solution.xs, solution.us)), rel=1e-12
    )


def test_success_is_what_says_so():
    for reason in jc.Reason:
        success = reason.message.startswith(("converged", "stationary"))
        assert bool(jc.Status.of(reason).ok) == success, reason.name
