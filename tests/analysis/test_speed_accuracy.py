"""Three laws of movement time, each recovered from its own data."""

import numpy as np
import pytest
from scipy.stats import linregress

from jaxctrl import analysis

AMPLITUDE, WIDTH = (g.ravel() for g in np.meshgrid([0.05, 0.1, 0.2], [0.005, 0.01, 0.02, 0.04]))
RATIO = AMPLITUDE / WIDTH
TIMES = {
    "logarithmic": (0.1, 0.12, 0.1 + 0.12 * np.log2(2 * RATIO)),
    "linear": (0.3, 0.015, 0.3 + 0.015 * RATIO),
    "power": (0.2, 0.4, 0.2 * RATIO**0.4),
}


def test_index_of_difficulty_of_a_target_twice_as_far_as_wide_is_two_bits():
    assert analysis.index_of_difficulty(0.2, 0.1) == pytest.approx(2)
    np.testing.assert_allclose(analysis.index_of_difficulty([0.1, 0.2], [[0.1], [0.05]]),
                               [[1, 2], [2, 3]])  # fmt: skip


@pytest.mark.parametrize("name", TIMES)
def test_each_law_recovers_its_own_data(name):
    a, b, times = TIMES[name]
    fits = analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, times)
    assert fits.best.name == name
    assert (fits.best.a, fits.best.b) == pytest.approx((a, b), rel=1e-5)
    assert fits.best.r_squared == pytest.approx(1)
    assert fits.best.cross_validated_error < 1e-6 < fits.laws[1].cross_validated_error
    np.testing.assert_allclose(fits.best.predict(AMPLITUDE, WIDTH), times, rtol=1e-6)


@pytest.mark.parametrize("name", TIMES)
def test_each_law_wins_on_its_own_data_with_small_noise(name):
    for seed in range(5):
        noise = 0.005 * np.random.default_rng(seed).standard_normal((5, RATIO.size))
        times = TIMES[name][2] + noise
        fits = analysis.fit_speed_accuracy(np.tile(AMPLITUDE, 5), np.tile(WIDTH, 5), times.ravel())
        assert fits.best.name == name
        assert fits.best.cross_validated_error == pytest.approx(0.005, rel=0.4)


def test_lines_equal_those_of_scipy():
    times = TIMES["power"][2] + 0.01 * np.random.default_rng(0).standard_normal(RATIO.size)
    fits = analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, times)
    for name, x in (("logarithmic", np.log2(2 * RATIO)), ("linear", RATIO)):
        line = linregress(x, times)
        law = fits[name]
        assert (law.a, law.b) == pytest.approx((line.intercept, line.slope))
        assert law.r_squared == pytest.approx(line.rvalue**2)


def test_the_power_law_minimises_the_squared_error_of_time():
    times = TIMES["linear"][2] + 0.02 * np.random.default_rng(0).standard_normal(RATIO.size)
    law = analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, times)["power"]

    def cost(a, b):
        return ((times - a * RATIO**b) ** 2).sum()

    least = cost(law.a, law.b)
    for da, db in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3), (1e-3, -1e-3)):
        assert cost(law.a + da, law.b + db) > least


def test_cross_validation_leaves_out_all_repetitions_of_a_ratio():
    """Four ratios, each twice by another amplitude: the error is that of lines through three."""
    ratio = np.array([2.0, 4.0, 8.0, 16.0])
    times = np.array([0.3, 0.35, 0.5, 0.6])
    errors = []
    for i in range(4):
        kept = np.arange(4) != i
        line = linregress(np.log2(2 * ratio[kept]), times[kept])
        errors.append(times[i] - line.intercept - line.slope * np.log2(2 * ratio[i]))
    fits = analysis.fit_speed_accuracy(
        np.r_[ratio, 3 * ratio], np.r_[np.ones(4), 3 * np.ones(4)], np.r_[times, times]
    )
    expected = np.sqrt(np.mean(np.square(errors)))
    assert fits["logarithmic"].cross_validated_error == pytest.approx(expected)


def test_the_fits_print_as_a_table_sorted_by_cross_validated_error():
    fits = analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, TIMES["power"][2])
    rows = str(fits).splitlines()
    assert len(rows) == 4 and len({len(row) for row in rows}) == 1
    assert [row.split()[0] for row in rows[1:]] == [law.name for law in fits.laws]
    errors = [law.cross_validated_error for law in fits.laws]
    assert errors == sorted(errors)
    with pytest.raises(KeyError, match="fitts: one of power"):
        fits["fitts"]


def test_one_width_for_all_amplitudes_is_enough():
    fits = analysis.fit_speed_accuracy([0.05, 0.1, 0.2, 0.4], 0.02, [0.3, 0.4, 0.5, 0.6])
    assert fits.best.name == "logarithmic"
    assert (fits.best.a, fits.best.b) == pytest.approx((0.3 - 0.1 * np.log2(5), 0.1))


def test_effective_width_counts_scatter_along_the_movement_alone():
    along, across = np.random.default_rng(0).standard_normal((2, 50)) * [[0.01], [0.05]]
    c, s = np.cos(0.7), np.sin(0.7)
    points = np.stack([0.2 + c * along - s * across, 0.3 + s * along + c * across], axis=1)
    expected = np.sqrt(2 * np.pi * np.e) * along.std(ddof=1)
    assert analysis.effective_width(points, [3 * c, 3 * s]) == pytest.approx(expected, rel=1e-4)
    both = analysis.effective_width(np.stack([points, 2 * points]), [c, s])
    np.testing.assert_allclose(both, [expected, 2 * expected], rtol=1e-4)


WRONG = {
    "width of zero": (
        lambda: analysis.index_of_difficulty(0.1, 0.0),
        "width: finite numbers above 0 are wanted, got 0.0",
    ),
    "nan everywhere": (
        lambda: analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, np.full(12, np.nan)),
        "duration: finite numbers above 0",
    ),
    "shapes": (
        lambda: analysis.fit_speed_accuracy(AMPLITUDE, WIDTH, np.ones(11)),
        r"duration: shape \(11,\) given .* of shape \(12,\), wanted \(n,\)",
    ),
    "amplitude and width": (
        lambda: analysis.fit_speed_accuracy(AMPLITUDE, np.ones(5), np.ones(12)),
        r"width: shape \(5,\) given, wanted one that broadcasts with `amplitude` \(12,\)",
    ),
    "too few ratios": (
        lambda: analysis.fit_speed_accuracy([1, 2, 3, 2], [1, 2, 3, 1], [1, 1, 1, 2]),
        "amplitude: at least 4 different ratios to `width` are wanted, got 2",
    ),
    "points": (
        lambda: analysis.effective_width(np.ones((5, 3)), [1, 0]),
        r"points: shape \(5, 3\) given",
    ),
    "one point": (
        lambda: analysis.effective_width(np.ones((1, 2)), [1, 0]),
        "points: at least 2 samples",
    ),
    "direction": (
        lambda: analysis.effective_width(np.ones((5, 2)), [0, 0]),
        "direction: a length above 0",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_refused_by_name(case):
    call, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        call()
