"""Peaks and valleys of speed, and peaks of curvature."""

import numpy as np
import pytest

from jaxctrl import analysis

TS = np.linspace(0.0, 1.0, 101)
BELL = 30 * TS**2 * (1 - TS) ** 2


def two_bells(valley):
    """Speed that is 0 at 0 and 1, 1 at 1/4 and 3/4, and `valley` at 1/2."""
    return np.sin(np.pi * TS) ** 2 * (
        2 + (valley - 2) * np.cos(2 * np.pi * (TS - 0.5)) ** 2 * np.sin(np.pi * TS) ** 2
    )


def test_minimum_jerk_has_one_peak_of_1_875_and_no_valley():
    profile = analysis.speed_peaks(TS, 0.2 * BELL)
    assert profile.peak_times == pytest.approx([0.5])
    assert profile.peak_speeds == pytest.approx([1.875 * 0.2])
    assert profile.valley_times.shape == profile.valley_depth.shape == (0,)


@pytest.mark.parametrize("valley", [0.2, 0.6])
def test_a_double_peaked_profile_has_its_valley_and_depth(valley):
    profile = analysis.speed_peaks(TS, two_bells(valley))
    assert len(profile.peak_times) == 2
    assert profile.valley_times == pytest.approx([0.5])
    assert profile.valley_speeds == pytest.approx([valley])
    assert profile.valley_depth == pytest.approx(1 - valley / profile.peak_speeds.min())


def test_a_peak_between_samples_is_found_by_the_parabola_even_on_an_uneven_grid():
    ts = np.sort(np.r_[np.random.default_rng(1).uniform(0, 1, 50), 0, 1])
    profile = analysis.speed_peaks(ts, 1 - 4 * (ts - 0.456) ** 2 + 0.3)
    assert profile.peak_times == pytest.approx([0.456])
    assert profile.peak_speeds == pytest.approx([1.3])


def test_ripples_below_the_prominence_are_no_peaks():
    ripples = BELL + 0.005 * np.sin(60 * np.pi * TS) ** 2
    assert len(analysis.speed_peaks(TS, ripples).peak_times) == 1
    assert len(analysis.speed_peaks(TS, ripples, prominence=0.0).peak_times) > 1


def test_a_record_that_ends_in_full_movement_has_its_peak_at_the_end():
    profile = analysis.speed_peaks(TS, TS**2)
    assert profile.peak_times == pytest.approx([1.0])
    assert profile.peak_speeds == pytest.approx([1.0])


def test_a_plateau_is_one_peak_in_its_middle():
    speed = np.minimum(BELL, 1.0)
    assert analysis.speed_peaks(TS, speed).peak_times == pytest.approx([0.5])


def test_a_stop_between_peaks_has_depth_one():
    profile = analysis.speed_peaks(TS, np.abs(np.sin(2 * np.pi * TS)))
    assert profile.valley_depth == pytest.approx([1.0])
    assert (profile.valley_speeds >= 0).all()


def test_curvature_peaks_lie_at_the_speed_valleys_of_an_ellipse():
    ts = np.linspace(0, 1, 401)
    path = np.stack([0.1 * np.cos(2 * np.pi * ts + 1), 0.04 * np.sin(2 * np.pi * ts + 1)], axis=1)
    speed, kappa = analysis.speed(path, ts), analysis.curvature(path, ts)
    peaks = analysis.curvature_peaks(ts, -kappa, speed)
    exact = (np.array([1, 2]) * np.pi - 1) / (2 * np.pi)
    np.testing.assert_allclose(peaks.times, exact, atol=1e-4)
    np.testing.assert_allclose(peaks.heights, 0.1 / 0.04**2, rtol=1e-3)
    np.testing.assert_allclose(analysis.speed_peaks(ts, speed).valley_times, exact, atol=1e-4)


def test_curvature_peaks_leave_out_the_ends_and_missing_samples():
    bump = np.exp(-(((TS - 0.5) / 0.1) ** 2))
    ends = 50 * np.exp(-(((TS - 0.03) / 0.01) ** 2)) + 50 * np.exp(-(((TS - 0.97) / 0.01) ** 2))
    kappa = bump + ends
    kappa[[20, 21, 70]] = np.nan
    peaks = analysis.curvature_peaks(TS, kappa, BELL)
    assert peaks.times == pytest.approx([0.5])
    assert peaks.heights == pytest.approx([1.0], rel=1e-6)


WRONG = {
    "a batch": (
        lambda: analysis.speed_peaks(TS, np.ones((2, 101))),
        r"speed: shape \(2, 101\) given, wanted \(101,\)",
    ),
    "a gap": (
        lambda: analysis.speed_peaks(TS, np.where(TS == 0.5, np.nan, BELL)),
        "speed: finite numbers are wanted; leave out or fill the gaps",
    ),
    "nan everywhere": (lambda: analysis.speed_peaks(TS, TS * np.nan), "speed: no finite sample"),
    "too few": (lambda: analysis.speed_peaks([0, 1], [0, 1]), "ts: at least 3 samples"),
    "rest": (lambda: analysis.speed_peaks(TS, 0 * TS), "speed: a movement is wanted"),
    "prominence": (
        lambda: analysis.speed_peaks(TS, BELL, prominence=-0.1),
        "prominence: a fraction from 0 to below 1 is wanted, got -0.1",
    ),
    "curvature of another length": (
        lambda: analysis.curvature_peaks(TS, np.ones(100), BELL),
        r"curvature: shape \(100,\) given, wanted \(101,\)",
    ),
    "curvature only at the ends": (
        lambda: analysis.curvature_peaks(TS, np.where(TS < 0.01, 1.0, np.nan), BELL),
        "curvature: no finite sample within the movement",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_refused_by_name(case):
    call, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        call()
