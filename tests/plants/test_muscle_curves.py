import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxctrl.plants import (
    activation_of_state,
    activation_rate,
    active_state,
    control_of_rate,
    force_length,
    force_velocity,
    passive_force,
    tension,
)

L, V = np.meshgrid(np.linspace(0.5, 1.6, 45), np.linspace(-4, 4, 41))


@pytest.mark.parametrize(
    ("a", "l", "v", "want"),
    [
        (1.0, 1.0, 0.0, 0.50493),
        (1.0, 1.0, -1.0, 0.25930),
        (1.0, 1.0, 1.0, 0.68574),
        (0.5, 1.0, 0.0, 0.15030),
        (1.0, 0.8, 0.0, 0.13394),
        (1.0, 1.2, 0.0, 0.62166),
        (1.0, 0.6, 0.0, 0.00300),
    ],
)
def test_tension_has_the_tabulated_values(a, l, v, want):
    np.testing.assert_allclose(tension(a, l, v, "brown"), want, atol=5.1e-6)


@pytest.mark.parametrize("v", [-1.0, 0.0, 1.0])
def test_the_three_active_states_agree_at_full_activation_and_the_optimal_length(v):
    brown = tension(1.0, 1.0, v, "brown")
    np.testing.assert_allclose(tension(1.0, 1.0, v, "brown-fixed"), brown, rtol=1e-14)
    # 0.505 is A(1, 1), 1 - exp(-(1/(0.56 2.11))^2.11) = 0.50501, to three digits.
    np.testing.assert_allclose(tension(1.0, 1.0, v), brown, rtol=3e-5)


def test_the_linear_active_state_is_proportional_at_every_length():
    a = np.linspace(0, 1, 50)[:, None]
    np.testing.assert_allclose(active_state(a, L[:1]), 0.505 * a * np.ones_like(L[:1]), rtol=1e-15)
    fixed = active_state(a, L[:1], "brown-fixed")
    np.testing.assert_array_equal(fixed, fixed[:, :1] * np.ones_like(L[:1]))
    one = np.full_like(a, 1.0)
    np.testing.assert_allclose(fixed[:, :1], active_state(a, one, "brown"), rtol=1e-14)


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
def test_the_inverse_of_the_active_state_is_exact_within_its_bounds(curve):
    a, l = np.meshgrid(np.linspace(0.05, 1, 40), np.linspace(0.5, 1.6, 20))
    A = active_state(a, l, curve)
    np.testing.assert_allclose(activation_of_state(A, l, curve), a, rtol=1e-9)
    most = active_state(np.ones_like(l), l, curve)
    assert (most <= 1).all() and (most + 1e-15 >= A).all()
    assert (activation_of_state(most * (1 + 1e-9), l, curve) > 1).all()
    small = activation_of_state(np.zeros_like(l), l, curve)
    np.testing.assert_allclose(small, 0, atol=1.1e-9)
    slope = jax.vmap(jax.grad(lambda A: activation_of_state(A, 1.0, curve)))(jnp.zeros(3))
    assert jnp.isfinite(slope).all()


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
def test_nan_stays_nan(curve):
    for call in (active_state, activation_of_state):
        assert np.isnan(call(np.nan, 1.0, curve))
    assert np.isnan(tension(np.nan, 1.0, 0.0, curve))


def test_another_word_for_the_active_state_is_refused():
    for call in (active_state, activation_of_state, lambda a, l, c: tension(a, l, 0.0, c)):
        with pytest.raises(ValueError, match=r"active_state.*brown-fixed.*got 'hill'"):
            call(0.5, 1.0, "hill")


def test_the_curves_are_the_means_of_browns_fibres():
    """Brown, Cheng & Loeb (1999), slow and fast fibres, averaged parameter by parameter."""

    def mean(slow, fast):
        return (slow + fast) / 2

    beta, omega, rho = mean(2.30, 1.55), mean(1.26, 0.81), mean(1.62, 2.12)
    want = np.exp(-(np.abs((L**beta - 1) / omega) ** rho))
    np.testing.assert_allclose(force_length(L), want, atol=0.01)

    vmax, c0, c1 = mean(-4.06, -7.39), mean(5.88, -3.21), mean(0, 4.17)
    a0, a1, a2, b = mean(-4.70, -1.53), mean(8.41, 0), mean(-5.34, 0), mean(0.18, 1.05)
    shortening, lengthening = V <= 0, V > 0
    l, v = L[shortening], V[shortening]
    np.testing.assert_allclose(
        force_velocity(l, v), (vmax - v) / (vmax + (c0 + c1 * l) * v), atol=0.01
    )
    l, v = L[lengthening], V[lengthening]
    np.testing.assert_allclose(
        force_velocity(l, v), (b - (a0 + a1 * l + a2 * l**2) * v) / (b + v), atol=0.01
    )

    a = np.linspace(0.05, 1, 45)[None] * np.ones_like(L)
    exponent = 2.11 + mean(5.0, 3.31) * (1 / L - 1)
    want = 1 - np.exp(-((a / (0.56 * exponent)) ** exponent))
    np.testing.assert_allclose(active_state(a, L, "brown"), want, atol=0.01)


def test_the_passive_force_pushes_and_fades_with_length():
    np.testing.assert_allclose(passive_force(0.6), -0.02 * np.exp(13.8 - 18.7 * 0.6), rtol=1e-14)
    values = passive_force(np.linspace(0.4, 1.9, 50))
    assert (values < 0).all() and (np.diff(values) > 0).all()


def test_force_velocity_is_one_at_rest_zero_at_the_fastest_and_never_falls():
    lengths = np.linspace(0.5, 1.6, 30)
    np.testing.assert_array_equal(force_velocity(lengths, np.zeros(30)), 1)
    np.testing.assert_allclose(force_velocity(lengths, np.full(30, -5.72)), 0, atol=1e-15)
    assert (np.diff(force_velocity(L, V), axis=0) > 0).all()


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
def test_the_active_state_grows_with_activation_within_0_and_1(curve):
    a = np.linspace(0, 1, 50)[:, None]
    A = active_state(a, np.linspace(0.5, 1.6, 30)[None], curve)
    assert (np.diff(A, axis=0) > 0).all()
    assert A.min() >= 0 and A.max() < 1
    np.testing.assert_allclose(active_state(0.0, 1.0, curve), 0, atol=1e-15)


def test_the_inverse_of_the_activation_is_exact():
    a, u = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    rate = activation_rate(a, u)
    np.testing.assert_allclose(control_of_rate(a, rate), u, atol=4e-16)
    slower = activation_rate(a, u, 0.08, 0.03)
    np.testing.assert_allclose(control_of_rate(a, slower, 0.08, 0.03), u, atol=1e-15)
    assert (np.diff(rate, axis=0) > 0).all()


def test_controls_within_0_and_1_are_exactly_the_rates_within_their_bounds():
    a = np.linspace(0, 1, 41)
    np.testing.assert_allclose(activation_rate(a, np.zeros(41)), -a / 0.066, rtol=1e-14)
    np.testing.assert_allclose(activation_rate(a, np.ones(41)), (1 - a) / 0.05, rtol=1e-14)


def test_activation_rises_with_50_ms_and_falls_with_66_ms():
    np.testing.assert_allclose(activation_rate(0.0, 1.0), 1 / 0.050, rtol=1e-15)
    np.testing.assert_allclose(activation_rate(1.0, 0.0), -1 / 0.066, rtol=1e-15)
    np.testing.assert_allclose(activation_rate(0.2, 0.5), 0.3 / 0.058, rtol=1e-14)


def plain_tension(a, l, v, curve):
    factor = force_length(l) * force_velocity(l, v) + passive_force(l)
    return active_state(a, l, curve) * factor


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
def test_the_partial_derivatives_of_the_tension_are_those_of_plain_differentiation(curve):
    rng = np.random.default_rng(1)
    z = np.stack([rng.uniform(0.01, 1, 200), rng.uniform(0.5, 1.7, 200), rng.uniform(-3, 3, 200)])
    for operator in (jax.grad, jax.hessian):
        got, want = (
            jax.jit(jax.vmap(operator(lambda z, f=f: f(z[0], z[1], z[2], curve))))(z.T)
            for f in (tension, plain_tension)
        )
        np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def test_the_partial_derivatives_of_the_tension_are_finite_differences():
    rng = np.random.default_rng(2)
    z = np.stack([rng.uniform(0.1, 1, 50), rng.uniform(0.5, 1.7, 50), rng.uniform(0.1, 3, 50)])
    z[2, ::2] *= -1
    h = 1e-5
    for i in range(3):
        step = h * np.eye(3)[:, [i]]
        want = (tension(*(z + step)) - tension(*(z - step))) / (2 * h)
        got = jax.jit(jax.vmap(jax.grad(tension, i)))(*z)
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-8)


def test_the_tension_broadcasts_its_arguments():
    a, l = jnp.linspace(0.1, 1, 6), jnp.array(1.1)
    by_l = jax.jit(jax.jacfwd(lambda l: tension(a, l, 0.3)))(l)
    plain = jax.grad(lambda a, l: plain_tension(a, l, 0.3, "linear"), 1)
    want = jax.jit(jax.vmap(plain, (0, None)))(a, l)
    np.testing.assert_allclose(by_l, want, rtol=1e-13)


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
@pytest.mark.parametrize("operator", [jax.grad, jax.hessian])
def test_derivatives_of_the_tension_are_finite_at_its_kinks_and_poles(operator, curve):
    a, l = [0.0, 1e-9, 0.4, 1.0], [0.5, 1.0, 1.4]
    v = [-5.72 / 3.47, 0.0, 5.72 / 3.47, -0.62, 0.62]
    points = np.stack(np.meshgrid(a, l, v), -1).reshape(-1, 3)
    with jax.debug_nans(True):
        derivative = jax.jit(jax.vmap(operator(lambda z: tension(*z, curve))))(points)
    assert jnp.isfinite(derivative).all()


def test_derivatives_at_the_kinks_are_one_sided_limits():
    h = 1e-6
    # At l = 1 the force-length curve is flat.
    assert jax.grad(force_length)(1.0) == 0
    np.testing.assert_allclose(jax.grad(force_velocity, 1)(1.0, 0.0), -(1 + 3.47) / -5.72)
    left = (activation_rate(0.5, 0.5) - activation_rate(0.5, 0.5 - h)) / h
    np.testing.assert_allclose(jax.grad(activation_rate, 1)(0.5, 0.5), left, rtol=1e-8)
    np.testing.assert_allclose(jax.grad(control_of_rate, 1)(0.5, 0.0), 0.066)


def test_the_tension_is_continuously_differentiable_in_velocity_only_up_to_the_kink():
    left, right = (jax.grad(force_velocity, 1)(1.0, v) for v in (-1e-9, 1e-9))
    np.testing.assert_allclose(left, 4.47 / 5.72, rtol=1e-6)
    assert abs(right - left) > 0.1


def test_beyond_its_lengths_the_inverse_is_nan_as_the_curve_is():
    for length in (2.03, 2.5):
        assert np.isnan(activation_of_state(0.3, length, "brown"))
    assert np.isfinite(activation_of_state(0.3, 1.9, "brown"))
