"""Problems with a sensor: what ILQG makes of them, delays, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

DT, STEPS = 0.05, 12
A = np.array([[0.0, 1.0], [1.5, -0.3]])
B = np.array([[0.0], [1.0]])


class Point(jc.AbstractPlant):
    """dx/dt = A x + B u, unstable: what a test wants to know can be written down."""

    nx: int = eqx.field(static=True, default=2)
    nu: int = eqx.field(static=True, default=1)
    discrete: bool = eqx.field(static=True, default=False)
    control_bounds: None = None
    nominal_control: jax.Array = eqx.field(converter=jc.array_leaf, default=(0.0,))
    A: jax.Array = eqx.field(converter=jc.array_leaf, default=tuple(map(tuple, A)))

    def __call__(self, x, u, t):
        return self.A @ x + jnp.asarray(B, x.dtype) @ u


COV = np.diag([0.01, 0.04])
X0 = np.array([1.0, 0.0])
COST = jc.QuadraticCost(Q=np.eye(2), R=0.1 * np.eye(1), Qf=4 * np.eye(2))
EYE = jc.LinearSensor([[1.0, 0.0]], 0.05)


def point(sensor=EYE, cost=COST, sigma=0.1, **given):
    given = {"num_steps": STEPS, "dt": DT, "x0_cov": COV} | given
    noise = jc.SignalDependentNoise(sigma) + jc.AdditiveNoise(0.2)
    return jc.Problem(Point(), cost, noise=noise, sensor=sensor, **given)


def weaved(even, odd):
    return np.stack([even, odd], axis=1).reshape(-1, *np.shape(odd)[1:])


@pytest.fixture(scope="module")
def found():
    return jc.solve(point(), jc.ILQG(), X0)


def linear_parts(problem, x0):
    """Return the model of a linear problem around rest, from its own numbers and NumPy."""
    h, n = float(problem.dt), problem.num_steps
    fx, fu = np.eye(2) + h * A, h * B
    stack = lambda a: jnp.asarray(np.broadcast_to(a, (n, *np.shape(a))))  # noqa: E731
    c = np.zeros((2, 2))
    c[1, 1] = np.sqrt(h) * 0.2  # columns lead: the second is additive
    cu = np.zeros((2, 2, 1))
    cu[0, 1, 0] = np.sqrt(h) * 0.1
    noise = jc.linear.Noise(stack(c), None, stack(cu))
    return jc.LocalModel(
        stack(fx), stack(fu), stack(np.zeros(2)), stack(np.zeros(1)), stack(h * np.eye(2)),
        stack(np.zeros((1, 2))), stack(0.1 * h * np.eye(1)), jnp.zeros(2), 4 * jnp.eye(2), noise,
    )  # fmt: skip


def test_a_linear_problem_with_a_late_reading_is_the_published_predictor():
    """Li's filter corrects the next estimate: it is one of readings that come one step late."""
    problem = point(jc.LinearSensor([[1.0, 0.0]], 0.05).delayed(DT), x0_cov=None)
    solution = jc.solve(problem, jc.ILQG(gradient_tolerance=1e-10), X0)
    assert solution.status.ok, solution.status.message
    model = linear_parts(problem, X0)
    F = jnp.asarray(np.broadcast_to([[1.0, 0.0]], (STEPS, 1, 2)))
    d = jnp.full((STEPS, 1, 1), 0.05 / np.sqrt(DT))
    sensing = jc.linear.Sensing(F, noise=jc.linear.Noise(d))
    wanted = jc.linear.observed_lqg(model, sensing, 0 * COV, X0, tolerance=1e-14)
    np.testing.assert_allclose(solution.cost, wanted.cost, rtol=1e-10)
    # Controls on what is remembered are none: the best estimate of the state tells all.
    np.testing.assert_allclose(solution.policy.K[:, :, :2], wanted.law.K, atol=1e-8)
    np.testing.assert_allclose(solution.policy.K[:, :, 2:], 0.0, atol=1e-8)


def test_expected_costs_and_covariances_are_those_of_trials(found):
    assert found.status.ok
    trials = jc.evaluate(point(), found.policy, X0, key=jax.random.key(1), trials=20_000)
    z = (trials.costs.mean() - found.expected_cost) / (trials.costs.std() / np.sqrt(20_000))
    assert abs(z) < 3
    ends = np.cov(np.asarray(trials.ends).T)
    spread = np.asarray(found.prediction.x_cov[-1])
    bound = 4 * np.sqrt((spread**2 + np.outer(*[np.diag(spread)] * 2)) / 20_000)
    assert (np.abs(ends - spread) < bound).all()


def test_a_perfect_sensor_tells_the_state_and_a_useless_one_nothing():
    known = jc.solve(point(None, x0_cov=None), jc.ILQG(), X0)
    perfect = jc.solve(point(jc.LinearSensor(np.eye(2), 0.0), x0_cov=None), jc.ILQG(), X0)
    np.testing.assert_allclose(perfect.cost, known.cost, rtol=1e-12)
    np.testing.assert_allclose(perfect.us, known.us, atol=1e-9)
    np.testing.assert_allclose(perfect.policy.K, known.policy.K, atol=1e-9)
    useless = jc.solve(point(jc.LinearSensor(np.eye(2), 1e9), x0_cov=None), jc.ILQG(), X0)
    blind = jc.solve(point(jc.FunctionSensor(_nothing, 1.0), x0_cov=None), jc.ILQG(), X0)
    assert np.abs(useless.policy.estimator.G).max() < 1e-15
    np.testing.assert_allclose(useless.cost, blind.cost, rtol=1e-12)
    # The law is the open-loop one: its estimate is what the filter was told of its own controls.
    key = jax.random.key(0)
    run = jc.simulate(point(None, x0_cov=None), jc.OpenLoop(useless.us), X0, key=key)
    same = jc.simulate(
        point(jc.LinearSensor(np.eye(2), 1e9), x0_cov=None), useless.policy, X0, key=key
    )
    np.testing.assert_allclose(same.us, run.us, atol=1e-5)
    assert known.cost < jc.solve(point(x0_cov=None), jc.ILQG(), X0).cost < useless.cost


def _nothing(x, t):
    return jnp.zeros(1) * x[0]


def by_hand(delay_steps, sensor_sd):
    """Return the same problem as a discrete one, the readings of the last steps in its state."""
    n = delay_steps

    def move(z, u, t):
        after = z[:2] + DT * (jnp.asarray(A) @ z[:2] + jnp.asarray(B) @ u)
        return jnp.concatenate([after, z[:1], z[2:-1]])

    def noise(z, u, t):
        F = jnp.zeros((2 + n, 2)).at[1, 0].set(np.sqrt(DT) * 0.1 * u[0])
        return F.at[1, 1].set(np.sqrt(DT) * 0.2)

    def running(z, u, t):
        return DT * (0.5 * jnp.sum(z[:2] ** 2) + 0.05 * jnp.sum(u**2))

    plant = jc.FunctionPlant(move, nx=2 + n, nu=1, discrete=True)
    J = np.vstack([np.eye(2), np.repeat([[1.0, 0.0]], n, axis=0)])
    return jc.Problem(
        plant,
        jc.FunctionCost(running, lambda z: 2 * jnp.sum(z[:2] ** 2)),
        num_steps=STEPS,
        noise=jc.FunctionNoise(noise),
        sensor=jc.LinearSensor(np.eye(1, 2 + n, 1 + n), sensor_sd / np.sqrt(DT)),
        x0_cov=J @ COV @ J.T,
    ), J @ X0


@pytest.mark.parametrize("steps", [1, 3])
def test_a_delay_is_an_augmented_system_built_by_hand(steps):
    late = point(EYE.delayed(steps * DT))
    solution = jc.solve(late, jc.ILQG(gradient_tolerance=1e-10), X0)
    problem, z0 = by_hand(steps, 0.05)
    wanted = jc.solve(problem, jc.ILQG(gradient_tolerance=1e-10), z0)
    np.testing.assert_allclose(solution.cost, wanted.cost, rtol=1e-10)
    np.testing.assert_allclose(solution.us, wanted.us, atol=1e-10)
    # The library remembers both states, the other's readings being told by a matrix.
    own, hand = (s.policy.estimator.G for s in (solution, wanted))
    np.testing.assert_allclose(own[:, :2], hand[:, :2], atol=1e-10)
    np.testing.assert_allclose(own[:, 2::2], hand[:, 2:], atol=1e-10)
    K, hand = solution.policy.K, wanted.policy.K
    np.testing.assert_allclose(K[..., :2], hand[..., :2], atol=1e-9)
    np.testing.assert_allclose(K[..., 2:], 0.0, atol=1e-9)
    np.testing.assert_allclose(
        solution.prediction.x_cov, wanted.prediction.x_cov[:, :2, :2], atol=1e-12
    )
    np.testing.assert_allclose(np.asarray(late.lift(X0))[[0, 1, *range(2, 2 + 2 * steps, 2)]], z0)
    np.testing.assert_array_equal(late.project(wanted.xs), wanted.xs[:, :2])


def test_trials_with_different_delays_cost_what_is_expected():
    sensor = EYE.delayed(0.12) + jc.LinearSensor([[0.0, 1.0]], 0.2)
    problem = point(sensor)
    solution = jc.solve(problem, jc.ILQG(), X0)
    trials = jc.evaluate(problem, solution.policy, X0, key=jax.random.key(1), trials=20_000)
    z = (trials.costs.mean() - solution.expected_cost) / (trials.costs.std() / np.sqrt(20_000))
    assert abs(z) < 3
    now = jc.solve(point(EYE + jc.LinearSensor([[0.0, 1.0]], 0.2)), jc.ILQG(), X0)
    assert now.cost < solution.cost
    # What is told early is of a state that has lasted.
    run = jc.simulate(problem, solution.policy, X0)
    np.testing.assert_allclose(run.ys[:3, 0], X0[0])
    late = 0.4 * run.xs[:9, 0] + 0.6 * run.xs[1:10, 0]  # 2.4 steps
    np.testing.assert_allclose(run.ys[3:, 0], late, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.08, 0.1])
def test_derivatives_by_delay_and_step_are_differences(delay):
    problem = point(EYE.delayed(delay, steps=3))
    solver = jc.ILQG(gradient_tolerance=1e-10)

    @jax.jit
    def cost(delay, dt, sd):
        where = lambda p: (p.sensor.delay, p.dt, p.sensor.sensor.intensity)  # noqa: E731
        return jc.solve(eqx.tree_at(where, problem, (delay, dt, sd)), solver, X0).cost

    at = (jnp.array(delay), jnp.array(DT), jnp.array(0.05))
    slopes = jax.jit(jax.grad(cost, argnums=(0, 1, 2)))(*at)
    h = 1e-5
    for i, slope in enumerate(slopes):
        # One-sided where the delay is a whole number of steps, towards longer delays and shorter
        # steps.
        sign = -1 if i == 1 else 1
        moved = [(*at[:i], at[i] + sign * k * h, *at[i + 1 :]) for k in (1, 2)]
        one, two = (cost(*m) for m in moved)
        wanted = sign * (-1.5 * cost(*at) + 2 * one - 0.5 * two) / h
        np.testing.assert_allclose(slope, wanted, rtol=2e-5)


@pytest.mark.slow
def test_gradients_of_a_sensed_problem_are_differences():
    report = jc.check_gradients(point(num_steps=6), jc.ILQG(), X0)
    assert report.worst < 1e-6, report
    names = {row.name for row in report.rows}
    assert {"sensor.intensity", "noise.parts[0].intensity", "x0_cov"} <= names


def test_what_is_refused():
    with pytest.raises(ValueError, match="delay: at least 0"):
        EYE.delayed(-0.1)
    with pytest.raises(ValueError, match="longer than the movement of 12 steps"):
        point(EYE.delayed(0.7))
    with pytest.raises(ValueError, match="beyond its buffer of 1 steps"):
        point(EYE.delayed(0.1, steps=1))
    with pytest.raises(ValueError, match="intensity: at least 0"):
        jc.LinearSensor([[1.0, 0.0]], -1.0)
    for name in ("angle_sd", "velocity_sd", "velocity_fraction", "interval"):
        with pytest.raises(ValueError, match=f"{name}: at least 0"):
            jc.JointSensor(**{name: -0.1})
    with pytest.raises(ValueError, match=r"matrix: shape \(1, 3\), wanted \(ny, 2\)"):
        jc.solve(point(jc.LinearSensor([[1.0, 0.0, 0.0]], 0.1)), jc.ILQG(), X0)
    with pytest.raises(ValueError, match=r"returned \(\), wanted \(ny,\)"):
        jc.solve(point(jc.FunctionSensor(lambda x, t: x[0], 0.1)), jc.ILQG(), X0)
    with pytest.raises(TypeError, match="an arm is wanted, got Point"):
        jc.solve(point(jc.JointSensor()), jc.ILQG(), X0)
    with pytest.raises(ValueError, match="positive semidefinite"):
        point(x0_cov=np.diag([1.0, -1.0]))
    with pytest.raises(TypeError, match="SumSensor"):
        jc.SumSensor((EYE, 1.0))


def test_a_traced_delay_needs_a_buffer_and_is_nan_beyond_it():
    with pytest.raises(ValueError, match="steps="):
        jax.jit(lambda d: point(EYE.delayed(d)).num_readings)(0.1)

    @jax.jit
    def told(delay):
        problem = point(EYE.delayed(delay, steps=2))
        return jc.simulate(problem, jc.OpenLoop(jnp.zeros((STEPS, 1))), X0).ys

    assert np.isfinite(told(0.1)).all()
    assert np.isnan(told(0.11)).all()


def test_policies_fit_their_own_problem(found):
    known = jc.solve(point(None), jc.ILQG(), X0)
    with pytest.raises(ValueError, match="acts on the state"):
        jc.simulate(point(), known.policy, X0)
    with pytest.raises(ValueError, match="readings"):
        jc.simulate(point(EYE + EYE), found.policy, X0)
    with pytest.raises(ValueError, match="the problem of 13 steps"):
        jc.simulate(point(num_steps=STEPS + 1), found.policy, X0)
    again = jc.solve(point(), jc.ILQG(), X0, us=found.policy)
    assert int(again.num_steps) <= 1
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-9)
    shifted = found.policy.shifted(1)
    np.testing.assert_array_equal(shifted.estimator.G[:-1], found.policy.estimator.G[1:])
    assert jc.solve(point(), jc.ILQG(), found.xs[1], us=shifted).status.ok


def test_an_unstable_motion_that_is_not_seen_is_named():
    # The second state grows by itself, and tells nothing of itself in the first.
    apart = eqx.tree_at(lambda p: p.plant.A, point(), jnp.array([[0.0, 0.0], [0.0, 9.0]]))
    with pytest.warns(UserWarning, match="unstable motion around x0, mostly of state 1"):
        jc.solve(apart, jc.ILQG(), X0)


def test_a_sensor_that_is_not_finite_has_a_status():
    nan = jc.FunctionSensor(lambda x, t: jnp.log(x[:1] - 1.5), 0.1)
    assert jc.solve(point(nan), jc.ILQG(), X0).status.name == "NONFINITE_NOISE"
    with pytest.warns(UserWarning, match="ignores the problem's noise and sensor"):
        jc.solve(point(), jc.ILQR(), X0)


def test_files_tables_and_batches(found, tmp_path):
    jc.save(tmp_path / "a.npz", found)
    back = jc.load(tmp_path / "a.npz")
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(back), strict=True):
        np.testing.assert_array_equal(a, b)
    data = found.to_xarray()
    assert data["error_cov"].shape == (STEPS + 1, 2, 2) and data["G"].shape == (STEPS, 2, 1)
    assert "converged" in str(found)
    both = jc.solve_batch(point(), jc.ILQG(), np.stack([X0, 2 * X0]))
    np.testing.assert_allclose(both.cost[0], found.cost, rtol=1e-9)
    runs = jax.vmap(lambda p, x: jc.simulate(point(), p, x).xs[-1])(both.policy, both.xs[:, 0])
    assert runs.shape == (2, 2)
    assert jc.audit(point(), found).sound


def test_float32_agrees(found):
    problem, x0 = jax.tree.map(
        lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a,
        (point(), jnp.asarray(X0)),
    )
    single = jc.solve(problem, jc.ILQG(), x0)
    assert single.status.ok and single.us.dtype == jnp.float32
    np.testing.assert_allclose(single.cost, found.cost, rtol=1e-4)
    np.testing.assert_allclose(
        single.policy.K, found.policy.K, atol=2e-3 * np.abs(found.policy.K).max()
    )
