"""What theory predicts of the timing of least jerk from the shape of a closed path alone.

Along a path without inflections the tangent's angle theta is a coordinate. Near the circle, each
Fourier component of the log curvature over theta, with nu cycles a radian-turn, comes back in the
log speed of least jerk, times -beta(nu) (Huh & Sejnowski 2015): components do not interact, which
far from the circle is an approximation. In an inflection the log curvature is infinite, and there
is no prediction.
"""

import numpy as np

import jaxctrl as jc

from . import _closed_paths as shapes

_SAMPLES = 4096


def has_inflections(wave: np.ndarray) -> bool:
    """Tell whether the curvature of a path (harmonics, 2, 2) changes its sign."""
    kappa = _curvature(wave, np.linspace(0, 2 * np.pi, _SAMPLES))
    return bool(kappa.min() <= 0 <= kappa.max())


def predicted_exponent(wave: np.ndarray, phase: np.ndarray, trim: float) -> float:
    """Return the exponent that the predicted speed has, NaN for a path with inflections.

    Arguments:
        wave: coefficients of the path, (harmonics, 2, 2).
        phase: where along it the samples lie that the estimator is given [rad], (N,).
        trim: fraction of these that is left out at either end.
    """
    if has_inflections(wave):
        return np.nan
    along = np.linspace(0, 2 * np.pi, _SAMPLES)
    vx, vy = shapes.curve(wave, along, 1).T
    theta = np.unwrap(np.arctan2(vy, vx))
    turns = abs(round((theta[-1] - theta[0]) / (2 * np.pi)))
    share = (theta - theta[0]) / (theta[-1] - theta[0])  # of all the turning, increasing
    even = np.arange(_SAMPLES) / _SAMPLES
    kappa = _curvature(wave, np.interp(even, share, along))
    waves = np.fft.rfft(np.log(np.abs(kappa)))
    exponents = jc.analysis.least_jerk_exponent(np.arange(waves.size) / turns)
    log_speed = np.fft.irfft(-exponents * waves, _SAMPLES)
    passed = np.interp(np.mod(phase, 2 * np.pi), along, share)
    speed = np.exp(np.interp(passed, even, log_speed, period=1.0))
    return jc.analysis.power_law(speed, _curvature(wave, phase), trim=trim).exponent


def _curvature(wave: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the signed curvature [1/m] of a path at phases (n,) [rad]."""
    (vx, vy), (ax, ay) = shapes.curve(wave, phase, 1).T, shapes.curve(wave, phase, 2).T
    return (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3
