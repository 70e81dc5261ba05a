"""Derivatives, curvature, lengths and intervals, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxctrl import analysis

EVEN = np.linspace(0.0, 0.8, 81)
UNEVEN = np.sort(np.random.default_rng(0).uniform(0.0, 0.8, 81))
DISTANCE = 0.15


def minimum_jerk(ts, distance=DISTANCE):
    s = ts / ts[-1]
    return distance * s**3 * (10 - 15 * s + 6 * s**2)


def minimum_jerk_speed(ts, distance=DISTANCE):
    s = ts / ts[-1]
    return 30 * distance / ts[-1] * s**2 * (1 - s) ** 2


def reach(ts, direction=0.3):
    return minimum_jerk(ts)[:, None] * [np.cos(direction), np.sin(direction)]


def ellipse(ts, a=0.1, b=0.04, w=2 * np.pi):
    return np.stack([a * np.cos(w * ts), b * np.sin(w * ts)], axis=-1)


def ellipse_velocity(ts, a=0.1, b=0.04, w=2 * np.pi):
    return w * np.stack([-a * np.sin(w * ts), b * np.cos(w * ts)], axis=-1)


def ellipse_curvature(ts, a=0.1, b=0.04, w=2 * np.pi):
    return a * b / np.hypot(a * np.sin(w * ts), b * np.cos(w * ts)) ** 3


@pytest.mark.parametrize("ts", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_derivatives_are_exact_for_a_quadratic_and_a_cubic(ts):
    squares = np.stack([ts**2, 1 - 3 * ts], axis=1)
    cubes = np.stack([ts**3, ts**2 - ts], axis=1)
    slopes = np.stack([2 * ts, -3 + 0 * ts], axis=1)
    bends = np.stack([6 * ts, 2 + 0 * ts], axis=1)
    np.testing.assert_allclose(analysis.velocity(squares, ts), slopes, atol=1e-10)
    np.testing.assert_allclose(analysis.acceleration(cubes, ts), bends, atol=1e-6)


@pytest.mark.parametrize("derivative", [analysis.velocity, analysis.acceleration])
def test_halving_the_step_quarters_the_error_even_at_the_ends(derivative):
    order = 1 if derivative is analysis.velocity else 2

    def error(n):
        ts = np.linspace(0, 1, n + 1) + 0.3 * np.linspace(0, 1, n + 1) ** 2  # a smooth uneven grid
        path = np.stack([np.sin(3 * ts), np.cos(3 * ts)], axis=1)
        exact = 3**order * np.stack(
            [np.sin(3 * ts + order * np.pi / 2), np.cos(3 * ts + order * np.pi / 2)], axis=1
        )
        return np.abs(derivative(path, ts) - exact).max()

    assert 3.5 < error(100) / error(200) < 4.5


def test_acceleration_on_an_even_grid_is_the_second_difference():
    path = reach(EVEN)
    second = (path[2:] - 2 * path[1:-1] + path[:-2]) / 0.01**2
    np.testing.assert_allclose(analysis.acceleration(path, EVEN)[1:-1], second, atol=1e-10)


def test_peak_speed_of_minimum_jerk_is_1_875_times_the_mean():
    peak = analysis.speed(reach(EVEN), EVEN).max()
    assert peak == pytest.approx(1.875 * DISTANCE / 0.8, rel=1e-3)


def test_curvature_of_a_circle_is_one_over_its_radius_and_signed_by_the_turn():
    circle = ellipse(EVEN, 0.05, 0.05)
    np.testing.assert_allclose(analysis.curvature(circle, EVEN), 20, rtol=2e-2)
    np.testing.assert_allclose(analysis.curvature(circle[::-1], EVEN), -20, rtol=2e-2)


def test_exact_velocities_and_differences_agree_on_the_curvature_of_an_ellipse():
    ts = np.linspace(0, 1, 401)
    exact = ellipse_curvature(ts)[2:-2]
    by_path = analysis.curvature(ellipse(ts), ts)[2:-2]
    by_velocity = analysis.curvature(ellipse(ts), ts, velocities=ellipse_velocity(ts))[2:-2]
    np.testing.assert_allclose(by_path, exact, rtol=1e-3)
    np.testing.assert_allclose(by_velocity, exact, rtol=1e-3)


def test_curvature_is_nan_below_the_floor_and_where_the_hand_rests():
    kappa = analysis.curvature(reach(EVEN), EVEN, floor=0.05)
    slow = analysis.speed(reach(EVEN), EVEN) < 0.05 * analysis.speed(reach(EVEN), EVEN).max()
    np.testing.assert_array_equal(np.isnan(kappa), slow)
    assert np.isnan(analysis.curvature(np.ones((9, 2)), np.arange(9.0))).all()


def test_path_length_of_a_circle_is_its_circumference():
    circle = ellipse(np.linspace(0, 1, 2001), 0.05, 0.05)
    assert analysis.path_length(circle) == pytest.approx(2 * np.pi * 0.05, rel=1e-6)


def test_deviation_of_an_arc_is_its_height_positive_to_the_left():
    arc = ellipse(np.linspace(0.5, 0, 101), 0.05, 0.05)  # from -x over +y to +x
    assert analysis.deviation(arc) == pytest.approx(0.05)
    assert analysis.deviation(arc * [1, -1]) == pytest.approx(-0.05)
    assert analysis.deviation(arc[::-1]) == pytest.approx(-0.05)


def test_movement_interval_of_a_triangle_is_interpolated():
    onset, end = analysis.movement_interval(
        np.array([0.0, 1.0, 2.0, 4.0]), np.array([0.0, 0.0, 1.0, 0.0]), threshold=0.1
    )
    assert onset == pytest.approx(1.1)
    assert end == pytest.approx(3.8)


def test_movement_interval_of_a_record_cut_short_reaches_its_ends():
    onset, end = analysis.movement_interval(EVEN, np.ones(81))
    assert (onset, end) == (EVEN[0], EVEN[-1])


def test_minimum_jerk_is_symmetric_and_an_early_peak_is_not():
    speed = minimum_jerk_speed(EVEN)
    assert analysis.symmetry(EVEN, speed) == pytest.approx(0.5, abs=1e-12)
    assert analysis.symmetry(EVEN, EVEN * (0.8 - EVEN) ** 3) < 0.4


def test_a_batch_is_each_record_by_itself():
    paths = np.stack([reach(EVEN, angle) + 0.02 * ellipse(EVEN) for angle in (0, 1, 2)])
    speeds = analysis.speed(paths, EVEN)
    onsets, ends = analysis.movement_interval(EVEN, speeds)
    for i, path in enumerate(paths):
        np.testing.assert_array_equal(speeds[i], analysis.speed(path, EVEN))
        kappa = analysis.curvature(paths, EVEN)[i]
        np.testing.assert_allclose(kappa, analysis.curvature(path, EVEN), rtol=1e-9)
        assert analysis.deviation(paths)[i] == analysis.deviation(path)
        assert analysis.path_length(paths)[i] == analysis.path_length(path)
        assert (onsets[i], ends[i]) == analysis.movement_interval(EVEN, speeds[i])
        assert analysis.symmetry(EVEN, speeds)[i] == analysis.symmetry(EVEN, speeds[i])


def test_a_gap_makes_its_own_record_nan_and_no_other():
    paths = np.stack([reach(EVEN), reach(EVEN)])
    paths[0, 40] = np.nan
    speeds = analysis.speed(paths, EVEN)
    for found in (
        analysis.path_length(paths),
        analysis.deviation(paths),
        analysis.movement_interval(EVEN, speeds)[0],
        analysis.symmetry(EVEN, speeds),
    ):
        assert np.isnan(found[0]) and np.isfinite(found[1])
    assert np.isfinite(analysis.curvature(paths, EVEN)[0]).sum() > 50


def test_infinite_samples_count_as_missing():
    path = reach(EVEN)
    path[40] = np.inf
    assert np.isnan(analysis.acceleration(path, EVEN)[40]).all()
    assert np.isnan(analysis.path_length(path))


def test_jax_arrays_come_back_as_numpy_arrays():
    speed = analysis.speed(jnp.asarray(reach(EVEN)), jnp.asarray(EVEN))
    assert type(speed) is np.ndarray
    np.testing.assert_allclose(speed, analysis.speed(reach(EVEN), EVEN), atol=1e-12)


WRONG = {
    "three coordinates": (
        lambda: analysis.velocity(np.ones((81, 3)), EVEN),
        r"path: shape \(81, 3\) given, wanted \(\.\.\., N, 2\)",
    ),
    "other times": (lambda: analysis.speed(np.ones((80, 2)), EVEN), r"path: 80 samples .* 81 of"),
    "too few for one derivative": (
        lambda: analysis.velocity(np.ones((2, 2)), [0, 1]),
        "path: at least 3 samples are wanted, got 2",
    ),
    "too few for two": (
        lambda: analysis.curvature(np.ones((3, 2)), [0, 1, 2]),
        "path: at least 4 samples are wanted, got 3",
    ),
    "nan everywhere": (
        lambda: analysis.speed(np.full((81, 2), np.nan), EVEN),
        r"path: no finite sample in shape \(81, 2\)",
    ),
    "times that stand still": (
        lambda: analysis.velocity(np.ones((3, 2)), [0, 1, 1]),
        "ts: finite times that increase",
    ),
    "velocities": (
        lambda: analysis.curvature(reach(EVEN), EVEN, velocities=reach(EVEN)[1:]),
        r"velocities: shape \(80, 2\) given, wanted \(81, 2\)",
    ),
    "floor": (lambda: analysis.curvature(reach(EVEN), EVEN, floor=1.0), "floor: a fraction"),
    "closed path": (lambda: analysis.deviation(np.zeros((5, 2))), "path: a first and a last"),
    "text": (lambda: analysis.path_length("path"), "path: real numbers of shape"),
    "complex": (lambda: analysis.path_length(1j * np.ones((5, 2))), "path: real numbers"),
    "ragged": (lambda: analysis.path_length([[0, 1], [2]]), "path: real numbers"),
    "length of speed": (
        lambda: analysis.movement_interval(EVEN, np.ones(80)),
        r"speed: shape \(80,\) given, wanted \(\.\.\., 81\)",
    ),
    "negative speed": (
        lambda: analysis.movement_interval(EVEN, -np.ones(81)),
        "speed: at least 0 is wanted, got -1",
    ),
    "rest": (lambda: analysis.symmetry(EVEN, np.zeros(81)), "speed: a movement is wanted"),
    "threshold": (
        lambda: analysis.movement_interval(EVEN, np.ones(81), threshold=np.nan),
        "threshold: a fraction from 0 to below 1 is wanted, got nan",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_refused_by_name(case):
    call, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        call()
