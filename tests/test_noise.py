"""Noises, their sums, and their expansion along a trajectory against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.linear._step import columns as dense


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


X, U = np.array([0.7, 1.4, -0.5, 0.8]), np.array([0.6, -0.3])
SLOPES = np.random.default_rng(0).normal(size=(2, 4, 4))


def test_a_sum_has_the_columns_of_all(arm):
    parts = (
        jc.SignalDependentNoise([0.1, 0.2]),
        jc.AdditiveNoise(0.3),
        jc.StateDependentNoise(SLOPES),
    )
    both = parts[0] + parts[1] + parts[2]
    F = both(arm, X, U, 0.0)
    assert F.shape == (4, 6) and len(both.parts) == 3
    np.testing.assert_allclose(F, np.hstack([p(arm, X, U, 0.0) for p in parts]))
    assert len((parts[0] + (parts[1] + parts[2])).parts) == 3
    with pytest.raises(TypeError):
        parts[0] + 1.0


def test_noise_of_the_state_is_proportional_to_it(arm):
    F = jc.StateDependentNoise(SLOPES)(arm, X, U, 0.0)
    np.testing.assert_allclose(F, np.stack([C @ X for C in SLOPES], axis=1))
    np.testing.assert_allclose(
        jc.StateDependentNoise([0.1, 0, 0, 0.2])(arm, X, U, 0.0), np.diag([0.07, 0, 0, 0.16])
    )
    with pytest.raises(ValueError, match=r"slopes: shape \(3,\), wanted \(4,\) or"):
        jc.StateDependentNoise(np.ones(3))(arm, X, U, 0.0)


def test_a_plain_function_is_a_noise_with_derivatives():
    def diffusion(x, u, t, sigma):
        return jnp.stack([0.0 * x[1], sigma * jnp.sin(x[1])])[:, None] * (1 + u[0] ** 2)

    plant = jc.FunctionPlant(lambda x, u, t: jnp.stack([x[1], u[0]]), nx=2, nu=1)
    cost = jc.QuadraticCost(R=1.0, Qf=10.0)
    noise = jc.FunctionNoise(diffusion, params=0.2)
    problem = jc.Problem(plant, cost, num_steps=10, dt=0.1, noise=noise)
    start = np.array([1.0, 0.3])

    def cost_of(sigma):
        noisy = eqx.tree_at(lambda p: p.noise.params, problem, sigma)
        solution = jc.solve(noisy, jc.ILQG(gradient_tolerance=1e-9), start)
        return solution.expected_cost, solution

    found = cost_of(jnp.array(0.2))[1]
    assert found.status.ok and found.expected_cost > found.nominal_cost
    at = jnp.array(0.2)
    slope = jax.jvp(lambda sigma: cost_of(sigma)[0], (at,), (jnp.ones_like(at),))[1]
    difference = (cost_of(at + 1e-3)[0] - cost_of(at - 1e-3)[0]) / 2e-3
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_the_expansion_along_a_trajectory_agrees_with_differences():
    arm = jc.plants.MuscleArm()
    noise = jc.SignalDependentNoise(0.1) + jc.FunctionNoise(lambda x, u, t: x[:, None] ** 2 * u[0])
    task = jc.tasks.reach(arm, np.array([0.0, 0.4]), 0.1, num_steps=3)
    problem = eqx.tree_at(lambda p: p.noise, task, noise, is_leaf=lambda leaf: leaf is None)
    us = np.random.default_rng(1).uniform(0.2, 0.6, (3, 6))
    x0 = np.asarray(arm.at_rest(0.7, 1.5, activation=0.1))
    xs = problem.rollout(x0, us)
    found = jc.expand(problem, xs, us, noise=True).noise
    each = [dense(jax.tree.map(lambda a, k=k: a[k], found), 10, 6) for k in range(3)]
    cx, cu = (np.stack([parts[i] for parts in each]) for i in (1, 2))

    def columns(x, u):
        return np.sqrt(problem.dt) * np.asarray(noise(arm, x, u, 0.0)).T

    assert jc.expand(problem, xs, us).noise is None
    h = 1e-6
    for k in range(3):
        x, u = np.asarray(xs[k]), us[k]
        np.testing.assert_allclose(found.c[k], columns(x, u), rtol=1e-12, atol=1e-14)
        for j in range(10):
            d = h * np.eye(10)[j]
            slope = (columns(x + d, u) - columns(x - d, u)) / (2 * h)
            np.testing.assert_allclose(cx[k][..., j], slope, atol=1e-7)
        for j in range(6):
            d = h * np.eye(6)[j]
            slope = (columns(x, u + d) - columns(x, u - d)) / (2 * h)
            np.testing.assert_allclose(cu[k][..., j], slope, atol=1e-7)


def test_slopes_that_vanish_are_left_out(arm):
    task = jc.tasks.reach(arm, np.array([0.0, 0.4]), 0.1, num_steps=3)
    us = np.zeros((3, 2))
    for noise, parts in (
        (jc.AdditiveNoise(0.1 * np.eye(4)), (False, False)),
        (jc.StateDependentNoise(SLOPES), (True, False)),
        (jc.FunctionNoise(lambda x, u, t: jnp.pad(u, (2, 0))[:, None]), (False, True)),
    ):
        problem = eqx.tree_at(lambda p: p.noise, task, noise, is_leaf=lambda leaf: leaf is None)
        found = jc.expand(problem, problem.rollout(X, us), us, noise=True).noise
        assert (found.cx is not None, found.cu is not None) == parts


def test_bad_noise_is_refused(arm):
    task = jc.tasks.reach(arm, np.array([0.0, 0.4]), 0.1, num_steps=3)

    def with_noise(noise):
        return eqx.tree_at(lambda p: p.noise, task, noise, is_leaf=lambda leaf: leaf is None)

    for kind in (jc.SignalDependentNoise, jc.AdditiveNoise):
        with pytest.raises(ValueError, match="intensity: at least 0 is wanted"):
            kind(-0.1)
        edited = eqx.tree_at(lambda n: n.intensity, kind(0.1), jnp.array(-0.1))
        with pytest.raises(ValueError, match="intensity: at least 0 is wanted"):
            jc.solve(with_noise(edited), jc.ILQG(), X)
        with pytest.raises(ValueError, match=r"intensity: shape \(3,\)"):
            jc.solve(with_noise(kind([0.1, 0.1, 0.1])), jc.ILQG(), X)
    with pytest.raises(ValueError, match=r"FunctionNoise: returned \(4,\), wanted \(4, nw\)"):
        jc.solve(with_noise(jc.FunctionNoise(lambda x, u, t: x)), jc.ILQG(), X)
    with pytest.raises(ValueError, match="not finite"):
        jc.solve(with_noise(jc.AdditiveNoise(np.nan)), jc.ILQG(), X)
    with pytest.raises(TypeError, match="function"):
        jc.FunctionNoise(3.0)


@pytest.mark.parametrize(
    ("cov", "message"),
    [
        (np.eye(3), r"x0_cov: got shape \(3, 3\), wanted \(4, 4\)"),
        (np.diag([1.0, 1.0, 1.0, -0.1]), "positive semidefinite"),
        (np.triu(np.ones((4, 4))), "symmetric"),
        (np.full((4, 4), np.nan), "not finite"),
    ],
)
def test_what_is_no_covariance_is_refused(arm, cov, message):
    cost = jc.QuadraticCost(R=1.0)
    with pytest.raises(ValueError, match=message):
        jc.Problem(arm, cost, num_steps=3, x0_cov=cov)


def test_starts_are_drawn_from_their_covariance(arm):
    root = np.random.default_rng(0).normal(size=(4, 2))
    cov = 0.01 * root @ root.T  # singular
    problem = jc.Problem(arm, jc.QuadraticCost(R=1.0), num_steps=1, dt=1e-3, x0_cov=cov)
    policy = jc.OpenLoop(np.zeros((1, 2)))
    keys = jax.random.split(jax.random.key(0), 20_000)
    run = jax.vmap(lambda key: jc.simulate(problem, policy, X, key=key).xs[0])
    starts = np.asarray(jax.jit(run)(keys))
    products = np.einsum("ni,nj->nij", starts - X, starts - X)
    error = products.std(axis=0) / len(keys) ** 0.5
    assert (np.abs(products.mean(axis=0) - cov) < 4.5 * error).all()
    assert (np.abs(starts.mean(axis=0) - X) < 4.5 * starts.std(axis=0) / len(keys) ** 0.5).all()
    np.testing.assert_array_equal(jc.simulate(problem, policy, X).xs[0], X)


def test_per_cent_and_milliseconds_are_refused():
    with pytest.raises(ValueError, match="fraction: at most 10"):
        jc.SignalDependentNoise.from_fraction(20, interval=0.01)
    with pytest.raises(ValueError, match="interval: at most 1"):
        jc.SignalDependentNoise.from_fraction(0.2, interval=10)
    for interval in (0.0, -0.01):
        with pytest.raises(ValueError, match="interval: a time above 0"):
            jc.SignalDependentNoise.from_fraction(0.2, interval=interval)
    arm = jc.plants.TorqueArm()
    with pytest.raises(ValueError, match="motor_noise: at most 1"):
        jc.tasks.reach(arm, [0.0, 0.4], motor_noise=20)
    with pytest.raises(TypeError, match="SumNoise: a tuple of noises"):
        jc.SumNoise(())


def test_a_noise_is_added_to_a_problem():
    arm = jc.plants.TorqueArm()
    task = jc.tasks.reach(arm, [0.0, 0.4])
    one = task + jc.SignalDependentNoise(0.02)
    two = one + jc.AdditiveNoise(0.01)
    assert task.noise is None and isinstance(one.noise, jc.SignalDependentNoise)
    assert [type(part).__name__ for part in two.noise.parts] == [
        "SignalDependentNoise", "AdditiveNoise",
    ]  # fmt: skip
    with pytest.raises(ValueError, match="target: lies inside the obstacle"):
        task + jc.tasks.Obstacle([0.0, 0.4], 0.05)
