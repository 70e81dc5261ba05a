"""Sense, act, move: the same model in twice as many steps of the general kernels, and trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed_oracle import exact_cost, second_moments, trials
from test_observed import COV, NU, NX, NY, T, pair, plant, sensor

from jaxctrl.linear import (
    AffineLaw,
    Noise,
    Sensing,
    filter_gains,
    lqr,
    observed_law,
    sensed_lqg,
)
from jaxctrl.linear._factorised import factorise
from jaxctrl.linear._riccati import Free, Holding
from jaxctrl.linear._sensed import descend, forecast, price, respond, settle

NONE = np.zeros((T, NU))
START = second_moments(np.zeros(NX), COV)
STILL = AffineLaw(jnp.zeros((T, NU)), jnp.zeros((T, NU, NX)))


def sensed(seed):
    """Return a model with everything that `Problem` can ask for, and half the noise of `plant`."""
    full = sensor(seed, internal=False)
    c, cx, *_ = full.noise
    model = plant(seed)
    weight = np.random.default_rng(seed).normal(size=(T, NX, 2))
    noise = Noise(*(0.7 * a for a in model.noise[:3]), weight=weight @ weight.swapaxes(1, 2))
    sensing = Sensing(full.F, noise=Noise(c, cx))
    return model._replace(noise=noise, sensing=sensing, x0_cov=jnp.asarray(COV))


def weave(even, odd):
    """Return arrays that take turns, the first of each step from `even`."""
    return jnp.stack([even, odd], axis=1).reshape(-1, *odd.shape[1:])


def halved(model):
    """Return model and sensing in 2 T steps: in the even ones all stands still but the sensor.

    The weight of the noise within its step is that of the next, even one's state.
    """
    c, cx, cu, *_ = model.noise
    one = jnp.broadcast_to(jnp.eye(NX), model.fx.shape)
    unit = jnp.broadcast_to(jnp.eye(NU), model.luu.shape)
    two = model._replace(
        fx=weave(one, model.fx),
        luu=weave(unit, model.luu),
        noise=Noise(*(weave(0 * a, a) for a in (c, cx, cu))),
        **{
            n: weave(0 * a, a)
            for n in ("fu", "lx", "lu", "lxx", "lux")
            for a in (getattr(model, n),)
        },
        sensing=None,
        x0_cov=None,
    )
    sd, sdx = model.sensing.noise[:2]
    noise = Noise(weave(sd, 0 * sd), weave(sdx, 0 * sdx))
    return two, Sensing(weave(model.sensing.F, 0 * model.sensing.F), noise=noise)


def unweighed(model):
    return model._replace(noise=model.noise._replace(weight=None))


def doubled(law, gains):
    return (
        AffineLaw(weave(0 * law.k, law.k), weave(0 * law.K, law.K)),
        weave(gains, 0 * gains),
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_filter_for_any_law_and_its_cost_are_those_of_half_steps(seed):
    model, (law, _) = unweighed(sensed(seed)), pair(seed)
    found = forecast(model, law)
    two, sensing = halved(model)
    both, gains = doubled(law, found.gains)
    wanted = filter_gains(two, sensing, both, COV)
    np.testing.assert_allclose(found.gains, wanted[::2], atol=1e-12)
    cost, moments = exact_cost(two, sensing, both, gains, START)
    np.testing.assert_allclose(found.cost, cost, rtol=1e-12)
    Z = np.stack(moments[::2])
    mean = Z[:, :NX, -1]
    x_cov = Z[:, :NX, :NX] - mean[:, :, None] * mean[:, None]
    np.testing.assert_allclose(found.x_cov, x_cov, atol=1e-12 * np.abs(x_cov).max())
    apart = np.concatenate([np.eye(NX), -np.eye(NX), np.zeros((NX, 1))], axis=1)
    np.testing.assert_allclose(found.error, apart @ Z @ apart.T, atol=1e-12 * np.abs(Z).max())


@pytest.mark.parametrize("seed", range(3))
def test_the_law_for_any_filter_and_its_cost_are_those_of_half_steps(seed):
    model, (_, gains) = unweighed(sensed(seed)), pair(seed)
    law, errors, cost = respond(model, gains, Free(NONE))
    two, sensing = halved(model)
    wanted, _ = observed_law(two, sensing, weave(gains, 0 * gains))
    np.testing.assert_allclose(law.k, wanted.k[1::2], atol=1e-11 * np.abs(law.k).max())
    np.testing.assert_allclose(law.K, wanted.K[1::2], atol=1e-11 * np.abs(law.K).max())
    exact = exact_cost(two, sensing, *doubled(law, gains), START)[0]
    np.testing.assert_allclose(cost, exact, rtol=1e-12)
    # The model of a known state has the same law.
    same = lqr(price(model, gains, errors))
    np.testing.assert_allclose(same.k, law.k, atol=1e-12 * np.abs(law.k).max())
    np.testing.assert_allclose(same.K, law.K, atol=1e-12 * np.abs(law.K).max())


@pytest.mark.parametrize("seed", range(4))
def test_law_and_filter_in_turn_lower_the_cost_to_where_it_is_stationary(seed):
    model, (law, _) = sensed(seed), pair(seed)
    found = descend(model, law, NONE, NONE, NONE, max_steps=40)
    history = np.asarray(found.history).reshape(-1)
    history = history[np.isfinite(history)]
    assert len(history) < 80
    assert (np.diff(history) <= 1e-13 * np.abs(history[:-1])).all()

    two, sensing = halved(unweighed(model))
    weight = model.noise.weight

    def cost(law, gains):
        """Within-step weights added by the moments of each step's noise."""
        total, moments = exact_cost(two, sensing, *doubled(law, gains), START, jnp)
        for t in range(T):
            Z = moments[2 * t + 1]
            U = jnp.concatenate([jnp.zeros((NU, NX)), law.K[t], law.k[t][:, None]], axis=1)
            X = jnp.eye(NX, 2 * NX + 1)
            for i in range(model.noise.c.shape[1]):
                row = model.noise.cx[t, i] @ X + model.noise.cu[t, i] @ U
                row = row.at[:, -1].add(model.noise.c[t, i])
                total = total + 0.5 * jnp.sum(weight[t] * (row @ Z @ row.T))
        return total

    np.testing.assert_allclose(cost(found.law, found.gains), history[-1], rtol=1e-12)
    slope = jax.jit(jax.grad(cost, argnums=(0, 1)))
    far = max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope(law, found.gains)))
    rest = max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope(found.law, found.gains)))
    assert rest < 1e-8 * far


def test_what_is_held_stays_and_the_cost_still_falls():
    model, rng = sensed(0), np.random.default_rng(3)
    side = jnp.asarray(rng.choice([-1.0, 0.0, 1.0], (T, NU)))
    values = 0.3 * side
    found = descend(model, STILL, NONE, side, values, max_steps=40)
    history = np.asarray(found.history).reshape(-1)
    history = history[np.isfinite(history)]
    assert (np.diff(history) <= 1e-13 * np.abs(history[:-1])).all()
    np.testing.assert_array_equal(found.law.k[side != 0], values[side != 0])
    np.testing.assert_array_equal(found.law.K[side != 0], 0.0)
    law, _, cost = respond(model, found.gains, Holding(side == 0, values, NONE, NONE))
    np.testing.assert_allclose(cost, history[-1], rtol=1e-12)
    np.testing.assert_allclose(law.K, found.law.K, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_expected_costs_are_the_means_of_trials(seed):
    model = unweighed(sensed(seed))
    found = descend(model, STILL, NONE, NONE, NONE, max_steps=40)
    expected = forecast(model, found.law).cost
    two, sensing = halved(model)
    costs, _ = trials(
        two, sensing, *doubled(found.law, found.gains), np.zeros(NX), COV, 100_000, seed
    )
    assert abs(costs.mean() - expected) < 3 * costs.std() / np.sqrt(costs.size)


def test_derivatives_at_an_optimum_are_differences():
    model = sensed(1)
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * 0.1, model)
    along = along._replace(x0_cov=along.x0_cov @ along.x0_cov.T)
    weights = jnp.asarray(rng.normal(size=model.lux.shape))
    side = jnp.asarray(rng.choice([-1.0, 0.0, 0.0, 1.0], (T, NU)))

    @jax.jit
    def value(h):
        """Return a sum of what the model at an optimum depends on, its best gains above all."""
        priced = settle(jax.tree.map(lambda a, b: a + h * b, model, along), side)
        K = factorise(priced, side == 0).K
        return jnp.sum(K * weights) + jnp.sum(priced.lxx) + jnp.sum(priced.noise.weight)

    slope = jax.grad(value)(0.0)
    np.testing.assert_allclose(jax.jvp(value, (0.0,), (1.0,))[1], slope, rtol=1e-9)
    h = 1e-5
    np.testing.assert_allclose(slope, (value(h) - value(-h)) / (2 * h), rtol=1e-6)


def test_a_reading_that_says_all_or_nothing():
    model = sensed(2)
    still = Sensing(jnp.broadcast_to(jnp.eye(NX), (T, NX, NX)))
    perfect = descend(model._replace(sensing=still), STILL, NONE, NONE, NONE, max_steps=40)
    known = lqr(model._replace(sensing=None, x0_cov=None))
    np.testing.assert_allclose(perfect.gains, still.F, atol=1e-9)
    np.testing.assert_allclose(perfect.law.K, known.K, atol=1e-10 * np.abs(known.K).max())
    loud = model.sensing.noise._replace(c=1e9 * model.sensing.noise.c, cx=None)
    noise = Noise(loud.c[:, :1] * 0 + 1e9 * jnp.eye(NY)[None].repeat(T, 0))
    useless = descend(
        model._replace(sensing=model.sensing._replace(noise=noise)), STILL, NONE, NONE, NONE
    )
    assert np.abs(useless.gains).max() < 1e-15


def test_the_door_finds_the_same_and_refuses_what_does_not_fit():
    model, (law, _) = sensed(0), pair(0)
    wanted = descend(model, law, NONE, NONE, NONE, max_steps=40)
    found = sensed_lqg(model, law=law, max_steps=40)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    sensing = model.sensing
    wrong = (
        ("model.sensing", model._replace(sensing=None)),
        ("model.x0_cov", model._replace(x0_cov=None)),
        ("model.x0_cov: a covariance has no", model._replace(x0_cov=-model.x0_cov)),
        ("model.sensing.E", model._replace(sensing=sensing._replace(E=jnp.ones((T, NY, NU))))),
        ("sensing.F", model._replace(sensing=sensing._replace(F=sensing.F[:, :, :1]))),
    )
    for name, bad in wrong:
        with pytest.raises(ValueError, match=name):
            sensed_lqg(bad)
    with pytest.raises(ValueError, match=r"law\.k"):
        sensed_lqg(model, law=AffineLaw(law.k[1:], law.K))
    with pytest.raises(TypeError, match="model: "):
        sensed_lqg(sensing)
