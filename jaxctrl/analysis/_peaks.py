"""Peaks and valleys of speed, and peaks of curvature."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.signal import find_peaks

from .. import _samples
from ._kinematics import movement_interval
from ._parabola import vertex


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """The peaks of a speed profile and the valleys between them, in the order of time.

    Fields, for n peaks:
        peak_times [s], peak_speeds [m/s]: (n,).
        valley_times [s], valley_speeds [m/s]: (n - 1,), the lowest speed between two peaks.
        valley_depth: (n - 1,), 1 - valley speed / lower of the two neighbouring peaks: 0 for no
            valley, 1 where the hand stops.
    """

    peak_times: np.ndarray
    peak_speeds: np.ndarray
    valley_times: np.ndarray
    valley_speeds: np.ndarray
    valley_depth: np.ndarray


@dataclass(frozen=True, eq=False)
class CurvaturePeaks:
    """The peaks of |kappa|, in the order of time: times [s] (n,) and heights [1/m] (n,)."""

    times: np.ndarray
    heights: np.ndarray


def _vertices(ts: np.ndarray, values: np.ndarray, indices: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return times and heights (n,) of the parabolas' vertices around n samples."""
    found = np.array([vertex(ts, values, int(i)) for i in indices]).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _standing_out(values: np.ndarray, least: float) -> np.ndarray:
    """Return the indices of maxima of prominence `least`, the first of any that tie.

    Two maxima of exactly the same height with a shallow valley between them, as in a symmetric
    profile, count as prominent by `find_peaks`, both of them.
    """
    kept: list[int] = []
    for peak in find_peaks(values, prominence=least)[0]:
        if not kept or values[peak] - values[kept[-1] : peak].min() >= least:
            kept.append(int(peak))
    return np.array(kept, dtype=int)


def speed_peaks(ts: Any, speed: Any, *, prominence: float = 0.01) -> SpeedProfile:
    """Find the peaks of a speed profile and the valleys between them.

    Peaks are the maxima that stand out by `prominence` times the largest speed
    (`scipy.signal.find_peaks`). The profile counts as zero before and after the record: a reach
    from rest to rest has its peaks inside, and a record that ends in full movement, as a hit does,
    has a peak at its last sample. Times and heights are those of parabolas through three samples.

    Arguments:
        ts: times [s], (N,), N at least 3, increasing.
        speed: speeds [m/s], (N,), of one movement.
        prominence: fraction of the largest speed; 0.01 is our choice. Raise it for noisy speeds.
    Returns: `SpeedProfile`.
    Raises: ValueError for a wrong shape, too few samples, times that do not increase, a gap,
        negative speeds, no movement, or a prominence outside [0, 1).
    """
    ts = _samples.instants(ts, 3)
    speed = _samples.all_finite("speed", _samples.speeds(speed, ts.size, batched=False))
    least = _samples.fraction("prominence", prominence) * speed.max()
    peaks = _standing_out(np.pad(speed, 1), least) - 1
    valleys = [a + speed[a:b].argmin() for a, b in pairwise(peaks)]
    peak_times, peak_speeds = _vertices(ts, speed, peaks)
    valley_times, valley_speeds = _vertices(ts, speed, valleys)
    valley_speeds = np.maximum(valley_speeds, 0.0)  # a parabola may dip below a stop
    depth = 1 - valley_speeds / np.minimum(peak_speeds[:-1], peak_speeds[1:])
    return SpeedProfile(peak_times, peak_speeds, valley_times, valley_speeds, depth)


def curvature_peaks(
    ts: Any,
    curvature: Any,
    speed: Any,
    *,
    threshold: float = 0.1,
    prominence: float = 0.01,
) -> CurvaturePeaks:
    """Find the peaks of |kappa|, which coincide with valleys of speed in curved movements.

    The beginning and the end of the movement are left out, for there the hand is slow and its
    curvature badly determined; slow samples in between count, since a sharp bend is slow.

    Arguments:
        ts: times [s], (N,), N at least 3, increasing.
        curvature: kappa [1/m], (N,), signed or not; samples that are not finite are left out.
        speed: speeds [m/s], (N,), of the same movement.
        threshold: fraction of the peak speed that bounds the movement, as in
            `movement_interval`; 0.1 is our choice.
        prominence: fraction of the largest |kappa| by which a peak must stand out; 0.01 is our
            choice.
    Returns: `CurvaturePeaks`, those of parabolas through three samples. A maximum at the first or
        last sample is none.
    Raises: as `speed_peaks`, and ValueError for a curvature of another shape than `speed`.
    """
    ts = _samples.instants(ts, 3)
    speed = _samples.all_finite("speed", _samples.speeds(speed, ts.size, batched=False))
    wanted = f"({ts.size},), as long as `ts`"
    bend = np.abs(_samples.shaped("curvature", curvature, (ts.size,), wanted))
    prominence = _samples.fraction("prominence", prominence)
    onset, end = movement_interval(ts, speed, threshold=threshold)
    used = np.isfinite(bend) & (ts >= onset) & (ts <= end)
    if not used.any():
        raise ValueError("curvature: no finite sample within the movement")
    ts, bend = ts[used], bend[used]
    peaks = _standing_out(bend, prominence * bend.max())
    return CurvaturePeaks(*_vertices(ts, bend, peaks))
