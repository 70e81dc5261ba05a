"""ILQG against ILQR, multiplicative LQG in NumPy, simulated trials, and differences of solves."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl._local_model import expand
from jaxctrl._prediction import predict

T, DT = 30, 0.02
A = np.array([[0.0, 1.0, 0.0], [-2.0, -0.5, 1.0], [0.0, 0.0, -10.0]])
B = np.array([[0.0, 0.0], [0.3, -0.2], [10.0, 5.0]])
Q, R, QF = np.diag([1.0, 0.1, 0.0]), np.diag([0.02, 0.05]), np.diag([50.0, 5.0, 0.1])
X0 = np.array([1.0, 0.0, 0.2])
SIGMA = np.array([0.08, 0.05])
STATE = 0.05 * np.random.default_rng(0).normal(size=(2, 3, 3))
X0_COV = np.diag([1e-3, 2e-3, 0.0])


class Linear(jc.AbstractPlant):
    """dx/dt = A x + B u."""

    A: jax.Array = eqx.field(converter=jc.array_leaf)
    B: jax.Array = eqx.field(converter=jc.array_leaf)
    nx = 3
    nu = 2

    def __call__(self, x, u, t):
        return self.A @ x + self.B @ u


def linear(noise, x0_cov=None):
    cost = jc.QuadraticCost(Q=Q, R=R, Qf=QF)
    return jc.Problem(Linear(A, B), cost, num_steps=T, dt=DT, noise=noise, x0_cov=x0_cov)


def every():
    signal, state = jc.SignalDependentNoise(SIGMA), jc.StateDependentNoise(STATE)
    return signal + state + jc.AdditiveNoise(0.03 * np.eye(3))


def multiplicative(signal, state, additive, x0_cov):
    """Todorov's recursion for the fully observed case, in NumPy; E J from X0, and the gains."""
    F, G = np.eye(3) + DT * A, DT * B
    S, s, gains = QF.copy(), 0.0, []
    W = DT * additive @ additive.T
    for _ in range(T):
        H = DT * R + G.T @ S @ G
        for i, sigma in enumerate(signal):
            C = np.sqrt(DT) * np.outer(B[:, i] * sigma, np.eye(2)[i])
            H = H + C.T @ S @ C
        K = -np.linalg.solve(H, G.T @ S @ F)
        s += 0.5 * np.trace(S @ W)
        S = DT * Q + F.T @ S @ F + sum(DT * C.T @ S @ C for C in state) + K.T @ G.T @ S @ F
        gains.append(K)
    return 0.5 * X0 @ S @ X0 + 0.5 * np.trace(S @ x0_cov) + s, np.array(gains[::-1])


def test_a_linear_plant_started_at_its_deterministic_optimum_ends_at_multiplicative_lqg():
    problem = linear(every(), X0_COV)
    with pytest.warns(UserWarning, match="ignores the problem's noise"):
        deterministic = jc.solve(problem, jc.ILQR(), X0)
    solution = jc.solve(problem, jc.ILQG(), X0, deterministic.us)
    cost, gains = multiplicative(SIGMA, STATE, 0.03 * np.eye(3), X0_COV)
    assert solution.status.ok
    np.testing.assert_allclose(solution.expected_cost, cost, rtol=1e-10)
    np.testing.assert_allclose(solution.policy.K, gains, rtol=1e-8, atol=1e-8)
    # The nominal cost rises while the expected one falls: a frozen noise part would refuse.
    assert solution.nominal_cost > deterministic.nominal_cost * 1.0001
    assert solution.history.cost[0] > cost * 1.001


def test_a_solution_with_its_prediction_is_kept_and_shown(tmp_path):
    problem = linear(every(), X0_COV)
    solution = jc.solve(problem, jc.ILQG(), X0)
    jc.save(tmp_path / "solution.npz", solution)
    again = jc.load(tmp_path / "solution.npz")
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(solution), strict=True):
        np.testing.assert_array_equal(a, b)
    data = solution.to_xarray()
    np.testing.assert_array_equal(data.x_cov, solution.prediction.x_cov)
    assert data.u_cov.dims == ("step", "control", "control_")
    shown = str(solution)
    assert "expected" in shown and "nominal" in shown
    batch = jc.solve_batch(problem, jc.ILQG(), np.stack([X0, 2 * X0]))
    np.testing.assert_allclose(batch.expected_cost[0], solution.expected_cost, rtol=1e-10)
    np.testing.assert_allclose(batch.prediction.x_cov[0], solution.prediction.x_cov, rtol=1e-9)


def test_predictions_are_what_trials_on_a_linear_plant_show():
    problem = linear(every(), X0_COV)
    solution = jc.solve(problem, jc.ILQG(), X0)
    n = 40_000
    keys = jax.random.split(jax.random.key(1), n)
    trials = jax.jit(jax.vmap(lambda k: jc.simulate(problem, solution.policy, X0, key=k)))(keys)
    costs, xs, us = (np.asarray(a) for a in (trials.cost, trials.xs, trials.us))
    assert abs(costs.mean() - solution.cost) < 3.5 * costs.std() / n**0.5
    prediction = solution.prediction
    for values, mean, cov in (
        (xs, prediction.xs, prediction.x_cov),
        (us, prediction.us, prediction.u_cov),
    ):
        deviations = values - np.asarray(mean)
        error = values.std(axis=0) / n**0.5
        assert (np.abs(deviations.mean(axis=0)) <= 4.5 * error + 1e-12).all()
        products = deviations[..., :, None] * deviations[..., None, :]
        error = products.std(axis=0) / n**0.5
        assert (np.abs(products.mean(axis=0) - np.asarray(cov)) <= 4.5 * error + 1e-12).all()


@pytest.mark.parametrize("bounds", [None, (-0.5, 0.4)])
def test_without_noise_the_steps_are_ilqrs(bounds):
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    task = jc.tasks.reach(arm, arm.hand(x0) + jnp.array([-0.08, 0.08]), 0.3)
    problem = jc.Problem(
        arm, task.cost, num_steps=task.num_steps, dt=task.dt, control_bounds=bounds,
        noise=jc.SignalDependentNoise(0.0),
    )  # fmt: skip
    ours = jc.solve(problem, jc.ILQG(), x0)
    with pytest.warns(UserWarning):
        theirs = jc.solve(problem, jc.ILQR(), x0)
    assert ours.status.ok and ours.num_steps == theirs.num_steps
    np.testing.assert_allclose(ours.history.cost, theirs.history.cost, rtol=1e-12)
    np.testing.assert_allclose(ours.us, theirs.us, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.policy.K, theirs.policy.K, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.expected_cost, ours.nominal_cost, rtol=1e-14)
    assert float(jnp.abs(ours.prediction.x_cov).max()) == 0


@pytest.mark.slow
def test_derivatives_of_the_expected_cost_are_those_of_the_closed_form():
    problem = linear(every(), X0_COV)

    def cost(sigma, x0_cov):
        where = lambda p: (p.noise.parts[0].intensity, p.x0_cov)  # noqa: E731
        return jc.solve(eqx.tree_at(where, problem, (sigma, x0_cov)), jc.ILQG(), X0).cost

    found = jax.grad(cost, argnums=(0, 1))(jnp.asarray(SIGMA), jnp.asarray(X0_COV))
    for i in range(2):
        h = np.zeros(2)
        h[i] = 1e-5
        up, down = (multiplicative(SIGMA + d, STATE, 0.03 * np.eye(3), X0_COV)[0] for d in (h, -h))
        np.testing.assert_allclose(found[0][i], (up - down) / 2e-5, rtol=1e-7)
    E = 1e-3 * np.eye(3)
    up, down = (multiplicative(SIGMA, STATE, 0.03 * np.eye(3), X0_COV + d)[0] for d in (E, -E))
    np.testing.assert_allclose(np.sum(E * found[1]), (up - down) / 2, rtol=1e-9)


class Wheel(jc.AbstractPlant):
    """A pendulum with two drives of unlike strength, each noisy in itself."""

    gravity: jax.Array = eqx.field(converter=jc.array_leaf, default=4.0)
    nx = 2
    nu = 2

    def __call__(self, x, u, t):
        return jnp.stack([x[1], -self.gravity * jnp.sin(x[0]) + jnp.cos(x[0]) * u[0] + 0.5 * u[1]])


@pytest.fixture(
    scope="module",
    params=[pytest.param(None, marks=pytest.mark.slow), (-0.9, 0.9)],
    ids=["free", "bounded"],
)
def wheel(request):
    cost = jc.QuadraticCost(R=0.05, Qf=jnp.array([20.0, 2.0]), target=jnp.array([1.0, 0.0]))
    return jc.Problem(
        Wheel(), cost, num_steps=25, dt=0.04, noise=jc.SignalDependentNoise([0.15, 0.1]),
        control_bounds=request.param, x0_cov=1e-3 * np.eye(2),
    )  # fmt: skip


TIGHT = jc.ILQG(gradient_tolerance=1e-11, cost_tolerance=1e-14, step_tolerance=1e-10)


def outputs(parameters, problem, solver):
    where = lambda p: (p.noise.intensity, p.plant.gravity, p.cost.Qf, p.cost.target)  # noqa: E731
    problem = eqx.tree_at(where, problem, parameters[:4])
    s = jc.solve(problem, solver, parameters[4])
    aside = jc.simulate(problem, s.policy, parameters[4] + 0.1).xs[-1]
    spread = jnp.diagonal(s.prediction.x_cov, axis1=1, axis2=2)[4::20].reshape(-1)
    return jnp.concatenate(
        [s.cost[None], s.nominal_cost[None], s.us[::8].reshape(-1), s.policy.K[3].reshape(-1),
         spread, aside]
    ), s  # fmt: skip


PARAMETERS = (
    jnp.array([0.15, 0.1]), jnp.array(4.0), jnp.array([20.0, 2.0]), jnp.array([1.0, 0.0]),
    jnp.array([0.1, -0.2]),
)  # fmt: skip


def test_derivatives_under_noise_are_differences_of_solves(wheel):
    found, solution = outputs(PARAMETERS, wheel, TIGHT)
    assert solution.status.ok, solution.status.message
    held = (solution.policy.K == 0).all(axis=-1)
    assert held.any() == (wheel.bounds is not None)
    tight = jax.jit(lambda p: outputs(p, wheel, TIGHT)[0])
    along = jax.tree.map(lambda p: 0.3 + 0.2 * p, PARAMETERS)
    loose = lambda p: outputs(p, wheel, jc.ILQG())[0]  # noqa: E731
    _, pushed = jax.jvp(loose, (PARAMETERS,), (along,))
    h = 1e-4
    up, down = (
        tight(jax.tree.map(lambda p, a, h=h: p + h * a, PARAMETERS, along)) for h in (h, -h)
    )
    size = np.maximum(np.abs(pushed), 1e-2)
    np.testing.assert_allclose(pushed / size, (up - down) / (2 * h) / size, atol=2e-6)
    weights = np.random.default_rng(3).normal(size=found.shape)
    pulled = jax.grad(lambda p: weights @ loose(p))(PARAMETERS)
    both = sum(float(jnp.sum(a * b)) for a, b in zip(pulled, along, strict=True))
    np.testing.assert_allclose(both, weights @ pushed, rtol=1e-10)


def test_noise_that_no_feedback_holds_is_a_status():
    for intensity in (100.0, 1e200):
        noise = jc.StateDependentNoise(intensity * np.eye(3)[None])
        solution = jc.solve(linear(noise), jc.ILQG(), X0)
        assert solution.status.name == "NOISE_TOO_LARGE", str(solution)
    # Noise on the controls alone can be avoided: it ends with next to no control.
    solution = jc.solve(linear(jc.SignalDependentNoise(1e3)), jc.ILQG(), X0)
    assert solution.status.ok and np.abs(solution.us).max() < 1e-4


def test_an_end_that_is_not_converged_is_the_best_pair_that_was_met():
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    task = jc.tasks.reach(arm, arm.hand(x0) + jnp.array([-0.08, 0.08]), 0.5)
    problem = jc.Problem(  # nearly all controls at bounds: held sets, and costs, go in a circle
        arm, task.cost, num_steps=task.num_steps, dt=task.dt, control_bounds=(-0.5, 0.4),
        noise=jc.SignalDependentNoise(0.05),
    )  # fmt: skip
    solution = jc.solve(problem, jc.ILQG(), x0, max_steps=40)
    assert not solution.status.ok
    met = np.asarray(solution.history.cost)
    np.testing.assert_allclose(solution.expected_cost, np.nanmin(met), rtol=1e-12)
    assert met[40] > 1.001 * np.nanmin(met)
    at = np.nanargmin(met)
    np.testing.assert_allclose(solution.gradient, solution.history.gradient[at])


@pytest.mark.slow
def test_derivatives_of_what_did_not_converge_are_nan():
    problem = linear(every(), X0_COV)
    slope = jax.grad(lambda x0: jc.solve(problem, jc.ILQG(), x0, max_steps=0).cost)(X0)
    assert np.isnan(slope).all()


def test_float32_ends_where_float64_does(float32):
    problem = linear(every(), X0_COV)
    solution = jc.solve(problem, jc.ILQG(), X0.astype(np.float32))
    assert solution.us.dtype == jnp.float32 and solution.status.ok
    cost, gains = multiplicative(SIGMA, STATE, 0.03 * np.eye(3), X0_COV)
    np.testing.assert_allclose(solution.expected_cost, cost, rtol=1e-5)
    np.testing.assert_allclose(solution.policy.K, gains, rtol=1e-3, atol=1e-3)
    slope = jax.grad(
        lambda sigma: (
            jc.solve(
                eqx.tree_at(lambda p: p.noise.parts[0].intensity, problem, sigma), jc.ILQG(), X0
            ).cost
        )
    )(jnp.asarray(SIGMA))
    up, down = (
        multiplicative(SIGMA + d, STATE, 0.03 * np.eye(3), X0_COV)[0]
        for d in (np.array([1e-5, 0]), np.array([-1e-5, 0]))
    )
    np.testing.assert_allclose(slope[0], (up - down) / 2e-5, rtol=1e-3)


@pytest.mark.slow
def test_check_gradients_covers_what_the_noise_does():
    problem = linear(jc.SignalDependentNoise(SIGMA), X0_COV)
    report = jc.check_gradients(problem, jc.ILQG(), X0, where=lambda name: "intensity" in name)
    assert {row.output for row in report.rows} >= {"cost", "gains", "covariance"}
    assert report.worst < 1e-7, report


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_closed_form():
    problem = linear(every(), X0_COV)

    def cost(sigma):
        noisy = eqx.tree_at(lambda p: p.noise.parts[0].intensity, problem, sigma)
        return jc.solve(noisy, jc.ILQG(), X0).cost

    def exact(sigma):
        return multiplicative(sigma, STATE, 0.03 * np.eye(3), X0_COV)[0]

    h = 1e-4 * np.eye(2)
    differences = [
        [sum(a * b * exact(SIGMA + a * d + b * e) for a in (1, -1) for b in (1, -1)) for e in h]
        for d in h
    ]
    found = jax.hessian(cost)(jnp.asarray(SIGMA))
    np.testing.assert_allclose(found, np.array(differences) / (4e-8), rtol=5e-6)


@pytest.mark.slow
def test_second_derivatives_under_noise_are_differences_of_gradients(wheel):
    def value(theta):
        where = lambda p: (p.noise.intensity, p.plant.gravity)  # noqa: E731
        problem = eqx.tree_at(where, wheel, (theta[:2], theta[2]))
        solution = jc.solve(problem, TIGHT, theta[3:])
        return solution.cost + solution.us[3].sum() + solution.policy.K[4, 0, 0]

    slope = jax.jit(jax.grad(value))
    theta = jnp.array([0.15, 0.1, 4.0, 0.1, -0.2])
    along = jnp.array([0.1, -0.05, 1.0, 0.2, -0.3])
    _, found = jax.jit(lambda t: jax.jvp(slope, (t,), (along,)))(theta)
    h = 1e-4
    difference = (slope(theta + h * along) - slope(theta - h * along)) / (2 * h)
    np.testing.assert_allclose(found, difference, atol=1e-8 * np.abs(difference).max())


REACHES = {
    "torque": (jc.plants.TorqueArm, ("noise.intensity", "cost.parts[0].position", "weight")),
    "muscle": (jc.plants.MuscleArm, ("noise.intensity", "cost.parts[0].position", "alpha")),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", REACHES)
def test_derivatives_of_reaches_are_differences_of_solves(kind):
    plant, wanted = REACHES[kind]
    arm = plant()
    x0 = arm.at_rest(shoulder=np.pi / 4, elbow=np.pi / 2)
    target = arm.hand(x0) + jnp.array([-0.07, 0.07])
    problem = jc.tasks.reach(arm, target, 0.5, num_steps=50, motor_noise=0.02)
    report = jc.check_gradients(problem, jc.ILQG(), x0, where=lambda name: name.endswith(wanted))
    assert report.worst < 1e-4, report
    # GMRES leaves 3e-13 of the right side; half at bounds, the muscles' system magnifies that.
    assert max(row.transposed for row in report.rows) < 1e-8, report


@pytest.mark.slow
@pytest.mark.parametrize("plant", [jc.plants.TorqueArm, jc.plants.MuscleArm])
def test_half_the_time_step_leaves_paths_and_open_loop_ends(plant):
    arm = plant()
    x0 = arm.at_rest(shoulder=np.pi / 4, elbow=np.pi / 2)
    paths, blind, closed = [], [], []
    for num_steps in (50, 100, 200):
        problems = jc.tasks.centre_out(
            arm, x0, n=2, radius=0.1, duration=0.5, num_steps=num_steps, motor_noise=0.02
        )
        found = jc.solve_batch(problems, jc.ILQG(), x0)
        assert found.status.ok.all(), found.status.message

        def end_sd(problem, xs, us, K):
            cov = predict(problem, expand(problem, xs, us, noise=True), xs, us, K).x_cov[-1]
            slope = jax.jacfwd(arm.hand)(xs[-1])
            return jnp.sqrt(jnp.trace(slope @ cov @ slope.T))

        sd = jax.jit(jax.vmap(end_sd))
        paths.append(jax.vmap(jax.vmap(arm.hand))(found.xs)[:, :: num_steps // 50])
        blind.append(sd(problems, found.xs, found.us, jnp.zeros_like(found.policy.K)))
        closed.append(sd(problems, found.xs, found.us, found.policy.K))
    apart = [np.linalg.norm(b - a, axis=-1).max() for a, b in itertools.pairwise(paths)]
    assert apart[0] < 2e-3 and apart[1] < 0.65 * apart[0]
    np.testing.assert_allclose(blind[1] / blind[0], 1, atol=0.05)
    # Feedback acts on what is known at the last step: ends scatter by what noise did since, so
    # that their deviations fall with the step. They settle, but only at first order.
    first, second = (np.abs(np.log(b / a)) for a, b in itertools.pairwise(closed))
    assert (second < 0.65 * first).all(), (first, second)


class Acceleration(jc.AbstractResidual):
    """The change of the second state in a step, over its length."""

    of = "other"

    def residual(self, plant, at):
        """Return it, shape (1,)."""
        return (at.after[1:2] - at.x[1:2]) / at.dt * 0.1


def within_a_step(kind):
    """Return the end's cost as an event, or a cost that knows of the noise within a step."""

    def end(x):
        return 50 * (x[0] ** 2 + 0.1 * (x[1] - 1) ** 2)

    rest = jc.QuadraticCost(R=jnp.array([0.02, 0.05]))
    if kind == "terminal":
        return rest + jc.FunctionCost(terminal=end)
    if kind == "residual":
        return rest + jc.FunctionCost(terminal=end) + Acceleration()
    times = {"event": [T * DT], "between": [0.31, T * DT]}[kind]
    return rest + jc.FunctionCost(event=lambda x, i: end(x), event_times=times)


def test_events_and_residuals_weigh_the_noise_of_their_own_step():
    noise = jc.SignalDependentNoise(0.3) + jc.AdditiveNoise(0.05 * np.eye(3))
    found = {}
    for kind in ("terminal", "event", "between", "residual"):
        problem = jc.Problem(Linear(A, B), within_a_step(kind), num_steps=T, dt=DT, noise=noise)
        found[kind] = solution = jc.solve(problem, jc.ILQG(), X0)
        assert solution.status.ok
        costs = jc.evaluate(
            problem, solution.policy, X0, key=jax.random.key(2), trials=20_000
        ).costs
        costs = np.asarray(costs)
        assert abs(costs.mean() - solution.cost) < 3.5 * costs.std() / len(costs) ** 0.5, kind
    # An event at the end is the end's cost.
    np.testing.assert_allclose(found["event"].cost, found["terminal"].cost, rtol=1e-9)
    np.testing.assert_allclose(found["event"].us, found["terminal"].us, atol=1e-6)
    np.testing.assert_allclose(found["event"].policy.K, found["terminal"].policy.K, atol=1e-6)


def test_what_is_no_covariance_or_no_number_under_jit_is_a_status():
    problem = linear(jc.SignalDependentNoise(SIGMA), X0_COV)

    @jax.jit
    def tried(cov, sigma):
        where = lambda p: (p.x0_cov, p.noise.intensity)  # noqa: E731
        changed = eqx.tree_at(where, problem, (cov, sigma))
        s = jc.solve(changed, jc.ILQG(), X0, max_steps=2)
        drawn = jc.simulate(changed, jc.OpenLoop(s.us), X0, key=jax.random.key(0))
        return s.status.code, drawn.xs[0]

    indefinite = np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1.0]])
    for wrong in (-np.eye(3), indefinite, np.triu(np.ones((3, 3)))):
        code, start = tried(wrong, jnp.asarray(SIGMA))
        assert jc.Reason(int(code)).name == "INVALID_COVARIANCE"
        assert np.isnan(start).all()
    # Units far apart do not make one.
    far = np.diag([1e-14, 1.0, 1e8])
    code, start = tried(far, jnp.asarray(SIGMA))
    assert int(code) != int(jc.Reason.INVALID_COVARIANCE)
    assert (np.abs(start - X0) > 0.01 * np.sqrt(np.diag(far))).all()


def test_noise_that_is_not_finite_is_named_with_its_step():
    def late(x, u, t):
        return jnp.where(t > 0.2, jnp.nan, 0.1) * jnp.ones((3, 1))

    def of_a_norm(x, u, t):
        return 0.1 * jnp.sqrt(jnp.sum(u**2)) * jnp.ones((3, 1))

    for function, step in ((late, 11), (of_a_norm, 0)):
        solution = jc.solve(linear(jc.FunctionNoise(function)), jc.ILQG(), X0)
        assert solution.status.name == "NONFINITE_NOISE" and int(solution.status.index) == step


class Curved(jc.AbstractPlant):
    """An unstable second state, driven in proportion to a saturated control and to a product."""

    nx = 2
    nu = 2

    def __call__(self, x, u, t):
        pull = (1 + 0.5 * jnp.cos(x[0])) * jnp.tanh(u[0]) + 0.4 * u[1] * x[1] + 0.3 * u[1]
        return jnp.stack([x[1], 3 * jnp.sin(x[0]) - 0.3 * x[1] ** 3 + pull])


def test_ends_are_found_where_whole_steps_do_not_contract():
    target = jnp.array([0.3, 0.0])
    cost = jc.QuadraticCost(Q=jnp.array([0.5, 0.1]), R=0.1, Qf=jnp.array([8.0, 1.0]), target=target)
    x0, cov = jnp.array([0.6, -0.2]), 1e-3 * np.array([[1, 0.2], [0.2, 2]])

    def solve(solver, noise=None, x0_cov=None):
        problem = jc.Problem(Curved(), cost, num_steps=15, dt=0.06, noise=noise, x0_cov=x0_cov)
        return jc.solve(problem, solver, x0)

    # From the root of the model's gradient, found by SciPy, one whole step goes 2.6 times as far
    # to the other side.
    noisy = solve(jc.ILQG(), jc.SignalDependentNoise(0.2))
    assert noisy.status.ok, noisy.status.message
    np.testing.assert_allclose(noisy.cost, 0.2107310631723175, rtol=1e-7)
    # Parts of steps are recorded as such.
    steps = np.asarray(noisy.history.step[1 : int(noisy.num_steps) + 1])
    assert (steps[-5:] < 1).all() and (steps[-5:] > 0).all()
    # An uncertain start alone leaves the movement what it is.
    uncertain, certain = solve(jc.ILQG(), x0_cov=cov), solve(jc.ILQR())
    np.testing.assert_array_equal(uncertain.us, certain.us)
    assert uncertain.status.ok and uncertain.cost > certain.cost
