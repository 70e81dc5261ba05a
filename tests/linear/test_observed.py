"""Law and filter of what is only sensed, against other formulas and simulated trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed_oracle import exact_cost, second_moments, trials
from test_riccati import random_model

from jaxctrl._linalg import positive_part, solve_semidefinite
from jaxctrl.linear import (
    AffineLaw,
    Noise,
    Sensing,
    evaluate,
    evaluate_observed,
    filter_gains,
    lqr,
    observed_law,
    observed_lqg,
    observed_moments,
)

T, NX, NU, NY = 6, 4, 2, 3
COV = 0.3 * np.eye(NX) + 0.1


def plant(seed):
    """Return a model whose noise is additive, and grows with state and control."""
    rng = np.random.default_rng(500 + seed)
    shapes = ((0.3, (T, 3, NX)), (0.15, (T, 3, NX, NX)), (0.2, (T, 3, NX, NU)))
    noise = Noise(*(jnp.asarray(s * rng.normal(size=shape)) for s, shape in shapes))
    return random_model(seed, T=T)._replace(noise=noise)


def sensor(seed, internal=True):
    """Return a sensing with all that there is, or without the estimator's own noise."""
    rng = np.random.default_rng(600 + seed)
    shapes = ((0.3, (T, 2, NY)), (0.2, (T, 2, NY, NX)), (0.2, (T, 2, NY, NU)))
    noise = Noise(*(jnp.asarray(s * rng.normal(size=shape)) for s, shape in shapes))
    F, E = (jnp.asarray(rng.normal(size=(T, NY, n))) for n in (NX, NU))
    own = jnp.asarray(0.2 * rng.normal(size=(T, 2, NX)))
    return Sensing(F, E, noise, own if internal else None)


def pair(seed):
    """Return a law and a filter that are the best for nothing."""
    rng = np.random.default_rng(700 + seed)
    k, K, gains = (
        jnp.asarray(s * rng.normal(size=(T, *shape)))
        for s, shape in ((1.0, (NU,)), (0.3, (NU, NX)), (0.3, (NX, NY)))
    )
    return AffineLaw(k, K), gains


def start(seed):
    return np.random.default_rng(800 + seed).normal(size=NX)


def box(seed):
    """Return bounds that some controls will reach, and others not."""
    size = 10 ** np.random.default_rng(900 + seed).uniform(-2.5, 0.0, (T, NU))
    return jnp.asarray(-size), jnp.asarray(size)


@jax.jit
def oracle_slope(model, sensing, law, gains, first):
    """Return the gradient of the exact expected cost by law and filter."""

    def cost(law, gains):
        return exact_cost(model, sensing, law, gains, first, jnp)[0]

    return jax.grad(cost, argnums=(0, 1))(law, gains)


def test_cost_to_go_of_any_law_and_filter_is_that_of_the_moments_carried_forward():
    for seed in range(5):
        model, sensing, (law, gains) = plant(seed), sensor(seed), pair(seed)
        mean, estimate = start(seed), start(seed + 50)
        value = evaluate_observed(model, sensing, law, gains)
        wanted, _ = exact_cost(model, sensing, law, gains, second_moments(mean, 0 * COV, estimate))
        np.testing.assert_allclose(value.at(mean, estimate), wanted, rtol=1e-12)
        wanted, _ = exact_cost(model, sensing, law, gains, second_moments(mean, COV))
        spread = value.at(mean, mean) + 0.5 * np.sum(value.vxx * COV)
        np.testing.assert_allclose(spread, wanted, rtol=1e-12)


def test_moments_are_those_of_the_homogeneous_form():
    for seed in range(3):
        model, sensing, (law, gains) = plant(seed), sensor(seed), pair(seed)
        mean, estimate = start(seed), start(seed + 50)
        first = second_moments(mean, COV, estimate)
        cost, wanted = exact_cost(model, sensing, law, gains, first)
        found = observed_moments(model, sensing, law, gains, COV, mean, estimate)
        Z = np.array(wanted)
        m = Z[:, :-1, -1]
        cov = Z[:, :-1, :-1] - m[:, :, None] * m[:, None]
        size = np.abs(Z).max()
        np.testing.assert_allclose(found.cost, cost, rtol=1e-12)
        np.testing.assert_allclose(found.mean_x, m[:, :NX], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(found.mean_estimate, m[:, NX:], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(found.cov_x, cov[:, :NX, :NX], atol=1e-12 * size)
        np.testing.assert_allclose(found.cov_estimate, cov[:, NX:, NX:], atol=1e-12 * size)
        K = np.asarray(law.K)
        wanted_u = K @ cov[:-1, NX:, NX:] @ K.transpose(0, 2, 1)
        np.testing.assert_allclose(found.cov_u, wanted_u, atol=1e-12 * size)


@pytest.mark.parametrize("bounded", [False, True])
def test_cost_to_go_is_the_mean_of_simulated_trials(bounded):
    for seed in range(5):
        model, sensing, (law, gains) = plant(seed), sensor(seed), pair(seed)
        if bounded:
            law, value = observed_law(model, sensing, gains, bounds=box(seed))
            held = np.asarray((law.K == 0).all(axis=2))
            assert 0 < held.sum() < held.size
            assert np.asarray(jnp.abs(law.k) <= box(seed)[1]).all()
        else:
            value = evaluate_observed(model, sensing, law, gains)
        mean = start(seed)
        wanted = value.at(mean, mean) + 0.5 * np.sum(value.vxx * COV)
        costs, _ = trials(model, sensing, law, gains, mean, COV, 200_000, seed)
        z = (costs.mean() - wanted) / (costs.std() / np.sqrt(costs.size))
        print(
            f"seed {seed}, bounded {bounded}: {wanted:.4f} against {costs.mean():.4f}, z {z:+.2f}"
        )
        assert abs(z) < 3


def test_the_best_law_for_any_filter_leaves_a_cost_of_state_and_error_alone():
    """By induction V_hh + V_xh = 0 and v_h = 0, with bounds too."""
    for bounds in (None, box(0)):
        for seed in range(5):
            _, gains = pair(seed)
            law, value = observed_law(plant(seed), sensor(seed), gains, bounds=bounds)
            size = jnp.abs(value.vhh).max()
            np.testing.assert_allclose(value.vhh + value.vxh, 0.0, atol=1e-10 * size)
            np.testing.assert_allclose(value.vh, 0.0, atol=1e-10 * size)
            again = evaluate_observed(plant(seed), sensor(seed), law, gains)
            np.testing.assert_allclose(again.v, value.v, rtol=1e-12)


def stacked(make, count):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(make, range(count)))


@pytest.mark.parametrize("bounded", [False, True])
def test_no_half_sweep_raises_the_cost(bounded):
    """On 12 of 12 systems; what the last sweep finds is stationary in every gain, unless held."""
    models, senses = stacked(plant, 12), stacked(lambda seed: sensor(seed, False), 12)
    boxes = stacked(box, 12) if bounded else None

    def solve(model, sensing, bounds):
        return observed_lqg(model, sensing, COV, bounds=bounds, tolerance=-1.0, max_steps=60)

    found = jax.jit(jax.vmap(solve))(models, senses, boxes)
    assert found.converged.all() and found.ok.all()
    rises, largest = [], []
    for seed in range(12):
        history = np.asarray(found.history[seed]).ravel()
        history = history[np.isfinite(history)]
        rises.append(np.max(np.diff(history)) / history[-1])
        assert history[1] > history[-1]
        np.testing.assert_allclose(found.cost[seed], history.min(), rtol=1e-12)
        mine = jax.tree.map(lambda a, seed=seed: a[seed], (models, senses, found))
        model, sensing, own = mine
        slopes = oracle_slope(model, sensing, own.law, own.gains, second_moments(np.zeros(NX), COV))
        held = np.asarray((own.law.K == 0).all(axis=2))
        assert (0 < held.sum() < held.size) if bounded else not held.any()
        for slope in jax.tree.leaves(slopes):
            here = np.asarray(slope)
            here = here if here.shape[1] != NU else here[~held]
            largest.append(np.abs(here).max())
    print(f"bounded {bounded}: largest relative rise {max(rises):.1e}, slope {max(largest):.1e}")
    assert max(rises) < 1e-12
    assert max(largest) < 1e-8


def test_damping_may_raise_the_cost_but_the_best_pair_is_kept():
    found = observed_lqg(
        plant(0), sensor(0, False), COV, start(0), damping=3.0, tolerance=-1.0, max_steps=60
    )
    np.testing.assert_allclose(found.cost, np.nanmin(found.history), rtol=1e-12)


def test_gains_of_the_filter_make_every_error_the_least():
    model, sensing, (law, _) = plant(1), sensor(1, False), pair(1)
    gains = filter_gains(model, sensing, law, COV, start(1))
    best = observed_moments(model, sensing, law, gains, COV, start(1))
    # The error tells nothing that the estimate does not know.
    np.testing.assert_allclose(best.cov_cross, 0.0, atol=1e-12 * jnp.abs(best.cov_x).max())
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-1):
        other = gains + size * rng.normal(size=gains.shape)
        error = observed_moments(model, sensing, law, other, COV, start(1)).cov_error
        assert np.linalg.eigvalsh(error[1] - best.cov_error[1]).min() > -1e-12
        assert np.trace(error[-1]) > np.trace(best.cov_error[-1])


def test_a_state_that_is_sensed_exactly_gives_the_law_of_the_known_state():
    """Each step comes after one in which the state, with all its noise, is looked at."""
    known, mean = plant(2), start(2)

    def between(a, pause):
        """Put `pause` before every step of an array."""
        return jnp.stack([jnp.broadcast_to(pause, a.shape), a], axis=1).reshape(-1, *a.shape[1:])

    assert known.noise is not None
    model = known._replace(
        fx=between(known.fx, jnp.eye(NX)),
        luu=between(known.luu, jnp.eye(NU)),
        noise=Noise(*(between(a, 0.0) for a in known.noise[:3])),
        **{name: between(getattr(known, name), 0.0) for name in ("fu", "lx", "lu", "lxx", "lux")},
    )
    sensing = Sensing(between(jnp.zeros((T, NX, NX)), jnp.eye(NX)))
    found = observed_lqg(model, sensing, COV, mean)
    wanted = lqr(known)
    np.testing.assert_allclose(found.law.k[1::2], wanted.k, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(found.law.K[1::2], wanted.K, rtol=1e-9, atol=1e-10)
    value = evaluate(known, wanted.k, wanted.K)
    cost = value.v + value.vx @ mean + 0.5 * jnp.sum(value.vxx * (COV + jnp.outer(mean, mean)))
    np.testing.assert_allclose(found.cost, cost, rtol=1e-11)


def scaled(scales):
    """Return cost, a gain of the law and one of the filter, as the noise and a price are scaled."""
    model, sensing = plant(3), sensor(3, False)
    assert sensing.noise is not None
    sensing = sensing._replace(noise=jax.tree.map(lambda a: scales[0] * a, sensing.noise))
    model = model._replace(luu=scales[1] * model.luu)
    found = observed_lqg(model, sensing, COV, tolerance=-1.0, max_steps=40)
    return jnp.stack([found.cost, found.law.k[1, 0], found.law.K[2, 0, 1], found.gains[3, 1, 1]])


@pytest.mark.slow
def test_derivatives_of_the_fixed_point_are_those_of_differences():
    at, h = jnp.ones(2), 1e-5
    solve = jax.jit(scaled)
    differences = jnp.stack(
        [(solve(at + h * d) - solve(at - h * d)) / (2 * h) for d in jnp.eye(2)], axis=1
    )
    forward = jax.jit(jax.jacfwd(scaled))(at)
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.jacrev(scaled))(at), forward, rtol=1e-9, atol=1e-10)


def test_float32_reaches_the_same_cost():
    model, sensing = plant(4), sensor(4, False)
    wanted = observed_lqg(model, sensing, COV).cost

    def single(tree):
        return jax.tree.map(lambda a: np.asarray(a, np.float32), tree)

    with jax.enable_x64(False):
        found = observed_lqg(single(model), single(sensing), COV.astype(np.float32))
        assert found.cost.dtype == jnp.float32 and found.converged
    np.testing.assert_allclose(found.cost, wanted, rtol=1e-5)


def test_a_singular_system_is_solved_in_its_range():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 3)) * np.array([1e-3, 1, 1e3, 1, 1])[:, None]
    A, X = root @ root.T, rng.normal(size=(5, 2))
    np.testing.assert_allclose(A @ solve_semidefinite(A, A @ X), A @ X, rtol=1e-8)
    assert (solve_semidefinite(jnp.zeros((3, 3)), jnp.zeros((3, 1))) == 0).all()


def test_the_positive_part_has_derivatives_where_eigenvalues_are_equal():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)))[0]
    A, d = turn @ np.diag([2.0, 2.0, -1.0, -1.0]) @ turn.T, np.diag([1.0, 2.0, 3.0, 4.0])
    slope = jax.jvp(positive_part, (jnp.asarray(A),), (jnp.asarray(d),))[1]
    difference = (positive_part(A + 1e-6 * d) - positive_part(A - 1e-6 * d)) / 2e-6
    np.testing.assert_allclose(slope, difference, atol=1e-8)


WRONG = {
    "gains": (lambda m, s, l, g: (m, s, l, g[:, :, :2]), r"gains: got shape \(6, 4, 2\), wanted"),
    "law.K": (lambda m, s, l, g: (m, s, AffineLaw(l.k, l.K[:, :1]), g), "law.K: got shape"),
    "sensing.F": (lambda m, s, l, g: (m, s._replace(F=s.F[:3]), l, g), r"wanted \(6, 3, 4\)"),
    "sensing.noise.cx": (
        lambda m, s, l, g: (m, s._replace(noise=s.noise._replace(cx=s.noise.cu)), l, g),
        r"sensing.noise.cx: got shape \(6, 2, 3, 2\), wanted \(6, 2, 3, 4\)",
    ),
    "model.lux": (
        lambda m, s, l, g: (m._replace(lux=m.lux.at[2, 1, 0].set(jnp.nan)), s, l, g),
        r"model.lux: not finite at index \(2, 1, 0\)",
    ),
}


@pytest.mark.parametrize("which", WRONG)
def test_what_does_not_fit_is_named(which):
    change, message = WRONG[which]
    with pytest.raises(ValueError, match=message):
        evaluate_observed(*change(plant(0), sensor(0), *pair(0)))


def test_what_is_no_covariance_no_model_or_no_bounds_is_named():
    model, sensing, (_, gains) = plant(0), sensor(0), pair(0)
    with pytest.raises(ValueError, match=r"cov: a covariance has no negative eigenvalue, got -0.7"):
        observed_lqg(model, sensing, COV - np.eye(NX))
    with pytest.raises(ValueError, match="cov: a symmetric matrix is wanted"):
        observed_lqg(model, sensing, COV + np.eye(NX, k=1))
    with pytest.raises(ValueError, match=r"mean: got shape \(3,\), wanted \(4,\)"):
        observed_lqg(model, sensing, COV, np.zeros(3))
    with pytest.raises(ValueError, match="form: one of"):
        observed_lqg(model, sensing, COV, form="exact")
    with pytest.raises(ValueError, match="were they exchanged"):
        observed_law(model, sensing, gains, bounds=(1.0, -1.0))
    with pytest.raises(TypeError, match=r"sensing: a jc.linear.Sensing is wanted, got ArrayImpl"):
        evaluate_observed(model, sensing.F, *pair(0))
