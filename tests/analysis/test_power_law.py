"""The two-thirds power law: exact where it holds, absent where it does not, and in pure noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import linregress

from jaxctrl import analysis

TS = np.linspace(0.0, 3.0, 301)
PHASE = 2 * np.pi * TS
A, B = 0.1, 0.04
PATH = np.stack([A * np.cos(PHASE), B * np.sin(PHASE)], axis=1)
VELOCITY = 2 * np.pi * np.stack([-A * np.sin(PHASE), B * np.cos(PHASE)], axis=1)
KAPPA = A * B / np.hypot(A * np.sin(PHASE), B * np.cos(PHASE)) ** 3


def test_harmonic_ellipse_has_exponent_one_third():
    law = analysis.power_law(np.linalg.norm(VELOCITY, axis=1), KAPPA)
    assert law.exponent == pytest.approx(1 / 3, abs=1e-12)
    assert law.gain == pytest.approx(2 * np.pi * (A * B) ** (1 / 3))  # v = w (a b)^(1/3) r^(1/3)
    assert law.r_squared == pytest.approx(1)
    np.testing.assert_allclose(law.interval, 1 / 3, atol=1e-9)
    assert law.num_samples == 301 - 2 * 15


@pytest.mark.parametrize("velocities", [None, VELOCITY], ids=["path", "velocities"])
def test_harmonic_ellipse_has_exponent_one_third_by_differences(velocities):
    kappa = analysis.curvature(PATH, TS, velocities=velocities)
    law = analysis.power_law(analysis.speed(PATH, TS), kappa)
    assert law.exponent == pytest.approx(1 / 3, abs=1e-9)


def test_constant_speed_has_exponent_zero_and_nothing_to_explain():
    law = analysis.power_law(np.full(301, 0.3), KAPPA)
    assert law.exponent == pytest.approx(0, abs=1e-12)
    assert law.gain == pytest.approx(0.3)
    assert np.isnan(law.r_squared)


def test_constant_speed_on_a_sampled_ellipse_has_exponent_zero():
    fine = np.linspace(0, 2 * np.pi, 20001)
    dense = np.stack([A * np.cos(fine), B * np.sin(fine)], axis=1)
    arc = np.r_[0, np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))]
    phase = np.interp(np.linspace(0, arc[-1], 401), arc, fine)
    path, ts = np.stack([A * np.cos(phase), B * np.sin(phase)], axis=1), np.linspace(0, 1, 401)
    law = analysis.power_law(analysis.speed(path, ts), analysis.curvature(path, ts))
    assert law.exponent == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("exponent", [0.2, 0.5])
def test_a_synthetic_exponent_is_recovered_and_lies_in_the_interval(exponent):
    noise = 0.05 * np.random.default_rng(0).standard_normal(301)
    law = analysis.power_law(2 * KAPPA**-exponent * np.exp(noise), -KAPPA, trim=0)
    line = linregress(-np.log(KAPPA), np.log(2 * KAPPA**-exponent) + noise)
    assert law.exponent == pytest.approx(line.slope)
    assert law.gain == pytest.approx(np.exp(line.intercept))
    assert law.r_squared == pytest.approx(line.rvalue**2)
    assert law.interval[0] < exponent < law.interval[1]
    assert law.interval[1] - law.interval[0] == pytest.approx(4 * line.stderr, rel=0.3)


def test_the_interval_widens_when_neighbours_depend_on_one_another():
    white = np.random.default_rng(3).standard_normal(301)
    slow = np.convolve(white, np.ones(7), mode="same")
    widths = []
    for noise in (white, slow):
        law = analysis.power_law(KAPPA ** (-1 / 3) * np.exp(0.05 * noise / noise.std()), KAPPA)
        widths.append(law.interval[1] - law.interval[0])
    assert widths[1] > 1.5 * widths[0]


def test_the_interval_holds_the_exponent_of_noise_about_as_often_as_it_says():
    ts = np.arange(1000) / 100
    held = 0
    for seed in range(60):
        waves = np.random.default_rng(seed).standard_normal((2, 40, 2))
        f = np.linspace(0.1, 2.5, 40)[:, None] * 2 * np.pi * ts
        path = 0.05 * np.einsum("kd,kn->nd", waves[0], np.cos(f)) / 6
        path += 0.05 * np.einsum("kd,kn->nd", waves[1], np.sin(f)) / 6
        kappa = analysis.curvature(path, ts, floor=0)
        law = analysis.power_law(analysis.speed(path, ts), kappa, straight=0)
        held += law.interval[0] < 2 / 7 < law.interval[1]
    assert held >= 51


def test_each_record_has_a_gain_of_its_own():
    speeds = np.stack([tempo * KAPPA ** (-1 / 3) for tempo in (0.5, 1.0, 2.0)])
    law = analysis.power_law(speeds, np.stack([KAPPA] * 3))
    assert law.exponent == pytest.approx(1 / 3)
    assert law.gain == pytest.approx(1.0)
    assert law.r_squared == pytest.approx(1.0)


def test_a_list_of_records_equals_their_array_and_may_be_ragged():
    rng = np.random.default_rng(0)
    speeds = KAPPA ** (-1 / 3) * np.exp(0.1 * rng.standard_normal((8, 301)))
    stacked = analysis.power_law(speeds, np.stack([KAPPA] * 8))
    assert analysis.power_law(list(speeds), [KAPPA] * 8) == stacked
    ragged = analysis.power_law(
        [v[i:] for i, v in enumerate(speeds)], [KAPPA[i:] for i in range(8)]
    )
    assert ragged.exponent == pytest.approx(stacked.exponent, abs=0.01)
    assert stacked.interval[0] < stacked.exponent < stacked.interval[1]


def test_the_same_seed_gives_the_same_interval():
    speed = KAPPA ** (-1 / 3) * np.exp(0.1 * np.sin(7 * TS))
    assert analysis.power_law(speed, KAPPA, seed=1) == analysis.power_law(speed, KAPPA, seed=1)
    other = analysis.power_law(speed, KAPPA, seed=2)
    assert other.interval != analysis.power_law(speed, KAPPA, seed=1).interval


def test_straight_missing_and_resting_samples_and_the_ends_are_left_out():
    speed, kappa = KAPPA ** (-1 / 3), KAPPA.copy()
    kappa[100:110], kappa[120], speed[130], speed[140] = 0.5, np.nan, 0.0, np.inf
    law = analysis.power_law(speed, kappa, trim=0.1)
    assert law.num_samples == 301 - 60 - 13
    assert law.exponent == pytest.approx(1 / 3)
    assert analysis.power_law(speed, kappa, straight=0.1, trim=0).num_samples == 301 - 3


def test_smoothed_noise_gives_two_sevenths_where_nothing_is_left_out():
    null = analysis.power_law_null(60.0, 100.0, 2.0, straight=0, floor=0, trim=0, num_seeds=40)
    assert null.mean == pytest.approx(2 / 7, abs=4 * null.sd / np.sqrt(40))
    assert 0.005 < null.sd < 0.02
    assert null.exponents.shape == (40,)


def test_what_is_left_out_moves_the_exponent_of_noise():
    def mean(**rules):
        return analysis.power_law_null(60.0, 100.0, 2.0, num_seeds=20, **rules).mean

    assert mean(straight=0, floor=0.1) == pytest.approx(0.21, abs=0.015)
    assert mean() == pytest.approx(0.36, abs=0.015)


def test_the_null_depends_on_size_and_straightness_only_by_their_product():
    small = analysis.power_law_null(30.0, 100.0, 2.0, extent=0.05, straight=2.0, num_seeds=2)
    large = analysis.power_law_null(30.0, 100.0, 2.0, extent=0.1, straight=1.0, num_seeds=2)
    np.testing.assert_allclose(small.exponents, large.exponents)


def least_jerk_by_newton(frequency, eps=1e-3, num=64):
    """Return the exponent of a path with log curvature eps cos(frequency theta), timed optimally.

    The rate of the tangent's angle theta is exp(sum_k a_k cos(k frequency theta)); least is the
    integral of the squared jerk times the fifth power of the duration, which no tempo changes.
    Derivatives are Fourier's, the optimum is Newton's.
    """
    theta = 2 * np.pi * np.arange(num) / num
    order = np.fft.fftfreq(num, 1 / num) * (np.arange(num) != num // 2)
    slope = np.fft.ifft(1j * order[:, None] * np.fft.fft(np.eye(num), axis=0), axis=0).real
    cosines = np.cos(frequency * np.outer(theta, np.arange(1, 4)))

    def cost(a):
        rate = jnp.exp(cosines @ a)
        velocity = rate * np.exp(1j * theta - eps * np.cos(frequency * theta))
        jerk = rate * (slope @ (rate * (slope @ velocity)))
        return jnp.log(jnp.sum(jnp.abs(jerk) ** 2 / rate)) + 5 * jnp.log(jnp.sum(1 / rate))

    a = jnp.zeros(3)
    for _ in range(5):
        a = a - jnp.linalg.solve(jax.hessian(cost)(a), jax.grad(cost)(a))
    assert np.linalg.eigvalsh(jax.hessian(cost)(a)).min() > 0  # so it is a minimum
    return 1 - float(a[0]) / eps  # log v = log rate - log kappa = -beta log kappa


@pytest.mark.parametrize("frequency", [2, 3, 5])
def test_the_exponent_of_least_jerk_is_that_of_optimal_timing_near_the_circle(frequency):
    wanted = least_jerk_by_newton(frequency)
    assert analysis.least_jerk_exponent(frequency) == pytest.approx(wanted, abs=1e-5)


def test_the_exponent_of_least_jerk_falls_from_two_thirds_to_zero():
    beta = analysis.least_jerk_exponent([0.0, 2.0, 1e4])
    np.testing.assert_allclose(beta, [2 / 3, 30 / 91, 0], atol=1e-7)
    assert analysis.least_jerk_exponent(np.ones((2, 3))).shape == (2, 3)


WRONG = {
    "nan everywhere": (
        lambda: analysis.power_law(TS, np.full(301, np.nan)),
        r"curvature: no finite sample in shape \(301,\)",
    ),
    "too few samples": (
        lambda: analysis.power_law(np.ones(9), np.arange(2.0, 11.0)),
        "curvature: at least 10 samples are wanted .* above 1 / m, got 9 in record 0",
    ),
    "a straight path": (
        lambda: analysis.power_law(np.ones(301), np.full(301, 1e-9)),
        "curvature: at least 10 samples are wanted .* got 0 in record 0",
    ),
    "a circle": (
        lambda: analysis.power_law(np.ones(301), np.full(301, 20.0)),
        "curvature: one that varies is wanted",
    ),
    "shapes": (
        lambda: analysis.power_law(np.ones(301), KAPPA[1:]),
        r"curvature: records of \[300\] samples given, wanted \[301\]",
    ),
    "a batch of batches": (
        lambda: analysis.power_law(np.ones((2, 2, 301)), np.ones((2, 2, 301))),
        r"speed: shape \(2, 2, 301\) given, wanted \(N,\), \(trials, N\) or a list",
    ),
    "an entry": (
        lambda: analysis.power_law([np.ones(301), np.ones((301, 2))], [KAPPA, KAPPA]),
        r"speed\[1\]: shape \(301, 2\) given, wanted \(N,\)",
    ),
    "negative speed": (lambda: analysis.power_law(-KAPPA, KAPPA), "speed: at least 0 is wanted"),
    "straight": (
        lambda: analysis.power_law(KAPPA, KAPPA, straight=-1),
        "straight: a curvature .* of at least 0 is wanted, got -1",
    ),
    "frequency": (
        lambda: analysis.least_jerk_exponent([2.0, -1.0]),
        r"frequency: finite numbers from 0 are wanted, got \[2.0, -1.0\]",
    ),
    "trim": (
        lambda: analysis.power_law(KAPPA, KAPPA, trim=0.5),
        "trim: a fraction from 0 to below 0.5 is wanted, got 0.5",
    ),
    "cutoff": (
        lambda: analysis.power_law_null(10.0, 100.0, 30.0),
        "cutoff: from 5 / duration = 0.5 Hz to rate / 5 = 20 Hz is wanted, got 30",
    ),
    "extent": (
        lambda: analysis.power_law_null(10.0, 100.0, 2.0, extent=0.0),
        "extent: finite numbers above 0",
    ),
    "seeds": (
        lambda: analysis.power_law_null(10.0, 100.0, 2.0, num_seeds=1),
        "num_seeds: at least 2 are wanted, got 1",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_refused_by_name(case):
    call, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        call()
