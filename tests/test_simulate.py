"""Closed and open loop, with and without noise: against closed forms and standard errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc


def oscillator(x, u, t, p):
    return jnp.array([x[1], -p * x[0] - 0.5 * x[1] + u[0]])


def problem(noise=None, num_steps=40, dt=0.025, **arguments):
    plant = jc.FunctionPlant(oscillator, nx=2, nu=1, params=4.0)
    cost = jc.QuadraticCost(Q=1.0, R=0.1, Qf=10.0)
    return jc.Problem(plant, cost, num_steps=num_steps, dt=dt, noise=noise, **arguments)


X0 = jnp.array([1.0, 0.0])
KEY = jax.random.key(4)


@pytest.fixture(scope="module")
def solution():
    return jc.solve(problem(), jc.ILQR(), X0)


def test_noise_free_policy_reproduces_the_solution_and_its_cost(solution):
    trial = jc.simulate(problem(), solution.policy, X0)
    np.testing.assert_allclose(trial.xs, solution.xs, rtol=1e-12)
    np.testing.assert_allclose(trial.us, solution.us, rtol=1e-12)
    np.testing.assert_allclose(trial.cost, solution.cost, rtol=1e-12)
    np.testing.assert_allclose(trial.ts, 0.025 * np.arange(41), rtol=1e-12)


def test_feedback_brings_a_disturbed_start_back_and_open_loop_does_not(solution):
    disturbed = X0 + jnp.array([0.3, -0.5])
    closed = jc.simulate(problem(), solution.policy, disturbed)
    open_loop = jc.simulate(problem(), jc.OpenLoop(solution.us), disturbed)
    # For a linear plant and a quadratic cost the policy is optimal from any start.
    optimum = jc.solve(problem(), jc.ILQR(), disturbed).cost
    np.testing.assert_allclose(closed.cost, optimum, rtol=1e-9)
    assert open_loop.cost > 1.01 * closed.cost


def test_policy_and_open_loop_clip_to_the_bounds():
    bounded = problem(control_bounds=(-0.5, 0.25))
    solution = jc.solve(bounded, jc.ILQR(), X0)
    trial = jc.simulate(bounded, solution.policy, X0 + 3.0)
    assert trial.us.min() >= -0.5 and trial.us.max() <= 0.25
    trial = jc.simulate(bounded, jc.OpenLoop(10 * jnp.ones((40, 1)), bounded.bounds), X0)
    np.testing.assert_array_equal(trial.us, 0.25)


def covariance(problem, us, F):
    """Propagate the exact covariance of the linear plant under open-loop controls."""
    A = np.eye(2) + float(problem.dt) * np.array([[0, 1], [-4.0, -0.5]])
    P = np.zeros((2, 2))
    for u in np.asarray(us):
        P = A @ P @ A.T + float(problem.dt) * F(u) @ F(u).T
    return P


@pytest.mark.parametrize(
    ("noise", "F"),
    [
        (jc.AdditiveNoise(0.3), lambda u: np.array([[0.0], [0.3]])),
        (jc.SignalDependentNoise(0.2), lambda u: np.array([[0.0], [0.2 * u[0]]])),
        (jc.AdditiveNoise(np.diag([0.1, 0.2])), lambda u: np.diag([0.1, 0.2])),
    ],
    ids=["additive", "signal-dependent", "diffusion matrix"],
)
def test_monte_carlo_covariance_equals_the_propagated_one(noise, F):
    us = jnp.linspace(-2, 3, 40)[:, None]
    noisy, n = problem(noise), 20_000
    keys = jax.random.split(jax.random.key(0), n)
    ends = jax.vmap(lambda key: jc.simulate(noisy, jc.OpenLoop(us), X0, key=key).xs[-1])(keys)
    wanted = covariance(noisy, us, F)
    got = np.cov(ends.T)
    # The standard error of a sample covariance of Gaussians.
    error = np.sqrt((wanted**2 + np.outer(np.diag(wanted), np.diag(wanted))) / n)
    assert (np.abs(got - wanted) < 4 * error).all()
    mean_error = np.sqrt(np.diag(wanted) / n)
    mean = jc.simulate(noisy, jc.OpenLoop(us), X0).xs[-1]
    assert (np.abs(ends.mean(0) - mean) < 4 * mean_error).all()


def test_halving_the_step_leaves_the_endpoint_spread():
    us = jnp.ones((40, 1))
    fine = problem(jc.SignalDependentNoise(0.2), num_steps=80, dt=0.0125)
    coarse = problem(jc.SignalDependentNoise(0.2))
    keys = jax.random.split(jax.random.key(1), 20_000)

    def spread(problem, us):
        ends = jax.vmap(lambda key: jc.simulate(problem, jc.OpenLoop(us), X0, key=key).xs[-1])
        return ends(keys).std(0)

    np.testing.assert_allclose(spread(fine, jnp.repeat(us, 2, 0)), spread(coarse, us), rtol=0.05)


def test_noise_of_a_discrete_plant_is_per_step():
    plant = jc.FunctionPlant(lambda x, u, t: x, nx=1, nu=1, discrete=True)
    noisy = jc.Problem(
        plant, jc.QuadraticCost(Q=2.0), num_steps=10, dt=0.1, noise=jc.AdditiveNoise([[0.5]])
    )
    keys = jax.random.split(jax.random.key(2), 20_000)
    control = jc.OpenLoop(jnp.zeros((10, 1)))
    trials = jax.vmap(lambda key: jc.simulate(noisy, control, jnp.ones(1), key=key))(keys)
    np.testing.assert_allclose(trials.xs[:, -1].std(), 0.5 * np.sqrt(10), rtol=0.02)
    noise_free = jc.simulate(noisy, control, jnp.ones(1))
    np.testing.assert_allclose(noise_free.costs, [*[1.0] * 10, 0.0])


def test_fraction_and_interval_give_the_intensity():
    noise = jc.SignalDependentNoise.from_fraction(0.2, 0.01)
    np.testing.assert_allclose(noise.intensity, 0.02, rtol=1e-12)


def test_each_step_draws_its_noise_from_a_key_of_its_own():
    noisy, us = problem(jc.AdditiveNoise(np.diag([0.1, 0.2]))), jnp.ones((40, 1))
    trial = jc.simulate(noisy, jc.OpenLoop(us), X0, key=KEY)
    x = X0
    for i, step_key in enumerate(jax.random.split(jax.random.split(KEY)[1], 40)):
        xi = jax.random.normal(jax.random.split(step_key)[0], (2,))
        x = x + 0.025 * noisy.plant(x, us[i], 0.0) + 0.025**0.5 * jnp.array([0.1, 0.2]) * xi
        np.testing.assert_allclose(trial.xs[i + 1], x, rtol=1e-12)


def test_same_key_gives_the_same_trial_and_vmap_equals_a_loop(solution):
    noisy = problem(jc.AdditiveNoise(0.3))
    keys = jax.random.split(jax.random.key(3), 4)

    def run(key):
        return jc.simulate(noisy, solution.policy, X0, key=key).xs

    np.testing.assert_allclose(jax.vmap(run)(keys), [run(key) for key in keys], rtol=1e-12)
    assert not np.allclose(run(keys[0]), run(keys[1]))


def test_what_moves_may_differ_from_what_was_planned_with(solution):
    heavier = eqx.tree_at(lambda p: p.params, problem().plant, jnp.array(9.0))
    other = jc.simulate(problem(), solution.policy, X0, plant=heavier)
    assert not np.allclose(other.xs[-1], solution.xs[-1])
    noisy = jc.simulate(
        problem(), solution.policy, X0, key=jax.random.key(0), noise=jc.AdditiveNoise(0.1)
    )
    assert not np.allclose(noisy.xs[-1], solution.xs[-1])


def test_old_keys_are_accepted_and_key_reuse_is_never_found(solution):
    noisy = problem(jc.AdditiveNoise(0.3))
    trial = jc.simulate(noisy, solution.policy, X0, key=jax.random.PRNGKey(0))
    assert jnp.isfinite(trial.xs).all()
    with jax.debug_key_reuse(True):
        jc.simulate(noisy, solution.policy, X0, key=jax.random.key(0))


def test_dtypes_are_promoted_to_the_widest(solution):
    plain = jc.simulate(problem(), solution.policy, X0)
    mixed = jc.simulate(problem(), solution.policy, X0.astype(jnp.float32))
    assert mixed.xs.dtype == mixed.us.dtype == jnp.float64
    np.testing.assert_allclose(mixed.xs, plain.xs, atol=1e-5)


def test_simulation_is_differentiable_through_the_noise(solution):
    keys = jax.random.split(jax.random.key(5), 3)

    def cost(sigma):
        noisy = problem(jc.SignalDependentNoise(sigma))
        run = jax.vmap(lambda key: jc.simulate(noisy, solution.policy, X0, key=key).cost)
        return run(keys).mean()

    h = 1e-6
    difference = (cost(0.2 + h) - cost(0.2 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(cost)(0.2), difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"key": 0}, TypeError, r"key: a jax.random.key\(seed\) is wanted, got 0"),
        ({"key": jax.random.PRNGKey}, TypeError, "key: "),
        ({"noise": jc.AdditiveNoise(0.1)}, ValueError, "key: wanted together with `noise`"),
        ({"plant": jc.FunctionPlant(oscillator, nx=3, nu=1)}, ValueError, "plant: 3 states"),
    ],
)
def test_misuse_is_named(solution, arguments, error, match):
    with pytest.raises(error, match=match):
        jc.simulate(problem(), solution.policy, X0, **arguments)


def test_many_keys_or_a_forgotten_policy_are_named(solution):
    keys = jax.random.split(jax.random.key(0), 8)
    with pytest.raises(ValueError, match=r"key: got \(8,\) keys, .*jax.vmap"):
        jc.simulate(problem(), solution.policy, X0, key=keys)
    with pytest.raises(TypeError, match=r"controller: solution\.policy"):
        jc.simulate(problem(), solution, X0)
    with pytest.raises(ValueError, match="intensity: shape"):
        wrong = problem(jc.AdditiveNoise(np.zeros((3, 1))))
        jc.simulate(wrong, solution.policy, X0, key=jax.random.key(0))


def test_a_key_without_any_noise_warns(solution):
    with pytest.warns(UserWarning, match="key: given, but nothing is random"):
        jc.simulate(problem(), solution.policy, X0, key=jax.random.key(0))
