"""One step of the sweep, for any law and with noise, against moments carried forward in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_riccati import random_model

from jaxctrl._types import Noise, Rows, Sensing
from jaxctrl.linear import AffineLaw, box_lqr, evaluate, evaluate_observed, lqr, lqr_rollout
from jaxctrl.linear._step import pack

NX, NU, T = 4, 2, 6


def noisy(seed, kind="all"):
    """Return a random model whose steps are disturbed by three columns of noise."""
    rng = np.random.default_rng(100 + seed)
    c = jnp.asarray(0.3 * rng.normal(size=(T, 3, NX)))
    cx = jnp.asarray(0.2 * rng.normal(size=(T, 3, NX, NX)))
    cu = jnp.asarray(0.2 * rng.normal(size=(T, 3, NX, NU)))
    weight = rng.normal(size=(T, NX, NX))
    noise = {
        "all": Noise(c, cx, cu),
        "weighed": Noise(c, cx, cu, weight=jnp.asarray(weight @ weight.mT)),
        "additive": Noise(c),
        "of the controls": Noise(c, None, cu),
        "none": None,
    }[kind]
    return random_model(seed, T=T)._replace(noise=noise)


def law(seed):
    rng = np.random.default_rng(200 + seed)
    return jnp.asarray(rng.normal(size=(T, NU))), jnp.asarray(0.3 * rng.normal(size=(T, NU, NX)))


def expected_cost(model, k, K, dx0):
    """Carry the moments of z = (1, dx) forward, and weigh them: no recursion backwards."""
    z = np.concatenate([[1.0], dx0])
    Z, J = np.outer(z, z), 0.0
    for t in range(T):
        fx, fu, lx, lu, lxx, lux, luu = (np.asarray(a[t]) for a in model[:7])
        U = np.column_stack([k[t], K[t]])
        X = np.eye(1 + NX)[1:]
        linear = lx @ X + lu @ U
        square = X.T @ lxx @ X + U.T @ lux @ X + X.T @ lux.T @ U + U.T @ luu @ U
        J += linear @ Z[:, 0] + 0.5 * np.sum(square * Z)
        step = np.vstack([np.eye(1 + NX)[:1], fx @ X + fu @ U])
        after = step @ Z @ step.T
        if model.noise is not None:
            c, cx, cu, *_ = model.noise
            for i in range(c.shape[1]):
                column = np.zeros((NX, 1 + NX))
                column[:, 0] = c[t, i]
                column += 0 if cx is None else np.asarray(cx[t, i]) @ X
                column += 0 if cu is None else np.asarray(cu[t, i]) @ U
                after[1:, 1:] += column @ Z @ column.T
                if model.noise.weight is not None:
                    J += 0.5 * np.sum(np.asarray(model.noise.weight[t]) * (column @ Z @ column.T))
        Z = after
    vxx = np.pad(np.asarray(model.vxx), ((1, 0), (1, 0)))
    return J + np.asarray(model.vx) @ Z[1:, 0] + 0.5 * np.sum(vxx * Z)


@pytest.mark.parametrize("kind", ["all", "additive", "of the controls", "weighed", "none"])
def test_the_value_of_any_law_is_the_expected_cost(kind):
    for seed in range(3):
        model, (k, K) = noisy(seed, kind), law(seed)
        found = evaluate(model, k, K)
        for dx0 in np.random.default_rng(seed).normal(size=(3, NX)):
            got = found.v + found.vx @ dx0 + 0.5 * dx0 @ found.vxx @ dx0
            np.testing.assert_allclose(got, expected_cost(model, k, K, dx0), rtol=1e-11)


@pytest.mark.parametrize("kind", ["all", "of the controls"])
def test_the_sweeps_law_is_the_best_under_noise(kind):
    model = noisy(1, kind)
    best = lqr(model)
    dx0 = jnp.array([0.3, -0.2, 0.5, 0.1])

    @jax.jit
    def cost(k, K):
        found = evaluate(model, k, K)
        return found.v + found.vx @ dx0 + 0.5 * dx0 @ found.vxx @ dx0

    for slope, size in zip(jax.grad(cost, argnums=(0, 1))(best.k, best.K), (1.0, 1.0), strict=True):
        np.testing.assert_allclose(slope, 0.0, atol=1e-11 * size)
    without = lqr(model._replace(noise=None))
    assert cost(best.k, best.K) < cost(without.k, without.K) - 1e-3


@pytest.mark.parametrize("kind", ["all", "none"])
@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_a_fraction_of_the_law_changes_the_cost_as_promised(kind, damping):
    model = noisy(2, kind)
    found = lqr(model, damping)
    damped = model._replace(luu=model.luu + damping * jnp.eye(NU))
    nothing = evaluate(damped, 0 * found.k, found.K).v
    for a in (0.25, 1.0):
        change = evaluate(damped, a * found.k, found.K).v - nothing
        np.testing.assert_allclose(a * found.linear + a**2 * found.quadratic, change, rtol=1e-10)


def test_noise_that_is_zero_changes_nothing():
    model = noisy(0, "none")
    silent = model._replace(noise=Noise(jnp.zeros((T, 2, NX))))
    for a, b in zip(lqr(silent), lqr(model), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_the_parallel_sweep_leaves_noise_to_the_other():
    model = noisy(0)
    for a, b in zip(lqr(model, engine="parallel"), lqr(model), strict=True):
        np.testing.assert_array_equal(a, b)


def test_under_noise_a_box_holds_the_mean_and_leaves_the_best_law_of_the_others():
    for seed in (0, 1, 2, 4):
        model = noisy(seed, "of the controls")
        free_law = lqr(model)
        _, dus = lqr_rollout(model, free_law.k, free_law.K, jnp.zeros(NX))
        upper = 0.5 * jnp.abs(dus) + 0.01
        found, side = box_lqr(model, -upper, upper)
        assert found.settled and found.ok
        free = np.asarray(side == 0)
        assert free.any() and not free.all()
        _, dus = lqr_rollout(model, found.k, found.K, jnp.zeros(NX))
        assert (np.abs(dus) <= np.asarray(upper) * (1 + 1e-12)).all()
        np.testing.assert_allclose(dus[~free], (side * upper)[~free])
        assert (found.K[~free] == 0).all()
        cost = lambda k, K: evaluate(model, k, K).v  # noqa: B023, E731
        k_slope, K_slope = jax.grad(cost, argnums=(0, 1))(found.k, found.K)
        np.testing.assert_allclose(k_slope[free], 0, atol=1e-11)
        np.testing.assert_allclose(K_slope[free], 0, atol=1e-10)
        assert (k_slope * side)[~free].max() < 0  # what is held pushes outwards
        for a in (0.3, 1.0):
            change = cost(a * found.k, found.K) - cost(0 * found.k, found.K)
            np.testing.assert_allclose(a * found.linear + a**2 * found.quadratic, change)


def test_where_no_set_reproduces_itself_under_noise_each_step_is_in_the_box_by_itself():
    model = noisy(3, "of the controls")  # here sets cycle, and the interior point does not end
    free_law = lqr(model)
    upper = 0.5 * jnp.abs(lqr_rollout(model, free_law.k, free_law.K, jnp.zeros(NX))[1]) + 0.01
    found, _ = box_lqr(model, -upper, upper)
    assert found.settled and (np.abs(found.k) <= np.asarray(upper)).all()
    cost = lambda k: evaluate(model, k, found.K).v  # noqa: E731
    slope = jax.grad(cost)(found.k)
    # The last step's, beyond which nothing depends on it; others' at dx = 0 are not these.
    _, dus = lqr_rollout(model, found.k, found.K, jnp.zeros(NX))
    assert (np.abs(dus) > np.asarray(upper)).any(), "K dx leaves the box, or this tests nothing"
    assert cost(found.k) < cost(0 * found.k) and np.isfinite(slope).all()
    change = cost(found.k) - cost(0 * found.k)
    np.testing.assert_allclose(found.linear + found.quadratic, change)


def test_joseph_s_form_keeps_in_float32_what_the_short_form_loses():
    """Integrators in series with a dear end: the short form errs by 1e-3 here."""

    def gains(dtype):
        def every(a):
            return jnp.asarray(np.tile(a, (60, *[1] * np.ndim(a))), dtype)

        model = random_model(0)._replace(
            fx=every(np.eye(NX) + 0.1 * np.eye(NX, k=1)),
            fu=every(0.1 * np.eye(NX)[:, -1:]),
            lx=every(np.zeros(NX)),
            lu=every(np.zeros(1)),
            lxx=every(np.zeros((NX, NX))),
            lux=every(np.zeros((1, NX))),
            luu=every(1e-5 * np.eye(1)),
            vx=jnp.ones(NX, dtype),
            vxx=1e3 * jnp.eye(NX, dtype=dtype),
        )
        return np.asarray(lqr(model).K, float)

    exact = gains(jnp.float64)
    with jax.enable_x64(False):
        found = gains(jnp.float32)
    assert np.abs(found - exact).max() <= 2e-4 * np.abs(exact).max()


def test_the_noise_of_all_steps_is_packed_without_calls_to_a_library():
    """A loop with such a call in it would not become one function on a CPU."""

    def squares(c):
        return pack(Noise(c), (10, 6)).square

    c = jnp.asarray(np.random.default_rng(0).normal(size=(50, 6, 10)))
    program = jax.jit(squares).lower(c).compile().as_text()
    assert "kCustom" not in program and "custom-call" not in program
    np.testing.assert_allclose(squares(c), 0.5 * jnp.einsum("tix,tiy->txy", c, c), atol=1e-12)
    assert squares(c[:, :0]).shape == (50, 10, 10)


def test_arrays_that_do_not_fit_are_refused():
    model, (k, K) = noisy(0), law(0)
    noise = model.noise
    nw = noise.c.shape[1]
    wrong = {
        "model.noise.rows": noise._replace(rows=Rows(((0,),)), cx=None, cu=noise.cu[:, :, :1]),
        "model.noise.cu": noise._replace(cx=None, cu=noise.cu[:, :1]),
        "model.noise.c": noise._replace(c=noise.c[..., :1]),
    }
    beyond = Rows(((0,),) * (nw - 1) + ((7,),))
    cases = [(name, model._replace(noise=part)) for name, part in wrong.items()]
    cases += [
        ("rows", model._replace(noise=noise._replace(rows=beyond, cx=None, cu=noise.cu[:, :, :1]))),
        ("model.lx", model._replace(lx=model.lx[:, :1])),
        ("model.luu", model._replace(luu=model.luu[:, :1, :1])),
    ]
    for name, bad in cases:
        with pytest.raises(ValueError, match=name):
            evaluate(bad, k, K)
        with pytest.raises(ValueError, match=name):
            lqr(bad)
    with pytest.raises(ValueError, match="k: got shape"):
        evaluate(model, k[:, :1], K)


def test_sensed_models_refuse_noise_that_is_not_finite():
    model, (k, K) = noisy(0), law(0)
    bad = model._replace(noise=model.noise._replace(cu=model.noise.cu.at[2, 0, 0, 0].set(jnp.nan)))
    sensing = Sensing(jnp.tile(jnp.eye(NX), (T, 1, 1)))
    with pytest.raises(ValueError, match=r"model.noise.cu: not finite at index \(2, 0, 0, 0\)"):
        evaluate_observed(bad, sensing, AffineLaw(k, K), jnp.zeros((T, NX, NX)))
