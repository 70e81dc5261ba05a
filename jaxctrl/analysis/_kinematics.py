"""Kinematics of sampled movements: derivatives, curvature, lengths, when they begin and end."""

from typing import Any

import numpy as np

from .. import _samples
from ._parabola import vertex


def _path_and_instants(path: Any, ts: Any, fewest: int) -> tuple[np.ndarray, np.ndarray]:
    path = _samples.path("path", path, fewest)
    ts = _samples.instants(ts, fewest)
    if path.shape[-2] != ts.size:
        raise ValueError(f"path: {path.shape[-2]} samples given for the {ts.size} of `ts`")
    return path, ts


def velocity(path: Any, ts: Any) -> np.ndarray:
    """Differentiate a path by second-order differences, at the ends one-sided.

    Arguments:
        path: positions [m], (..., N, 2), N at least 3.
        ts: times [s], (N,), increasing; they need not be evenly spaced.
    Returns: velocities [m/s], (..., N, 2), exact for positions quadratic in time. NaN beside
        samples that are not finite. Differences amplify noise: filter measured positions first.
    Raises: ValueError for a wrong shape, too few samples, times that do not increase, or no
        finite sample.
    """
    path, ts = _path_and_instants(path, ts, 3)
    return np.gradient(path, ts, axis=-2, edge_order=2)


def acceleration(path: Any, ts: Any) -> np.ndarray:
    """Differentiate a path twice, through the cubic of the four samples around each sample.

    On an even grid this is (x_{k+1} - 2 x_k + x_{k-1}) / dt^2 inside, whose error is a quarter of
    that of a gradient taken twice. Second-order at the ends and on uneven grids too, where a
    gradient taken twice and three-point formulas are first-order.

    Arguments:
        path: positions [m], (..., N, 2), N at least 4.
        ts: times [s], (N,), increasing; they need not be evenly spaced.
    Returns: accelerations [m/s^2], (..., N, 2), exact for positions cubic in time. NaN beside
        samples that are not finite. Differences amplify noise: filter measured positions first.
    Raises: as `velocity`.
    """
    path, ts = _path_and_instants(path, ts, 4)
    first = np.clip(np.arange(ts.size) - 1, 0, ts.size - 4)
    window = first[:, None] + np.arange(4)
    nodes = ts[window] - ts[:, None]  # (N, 4), relative to the sample
    others = ~np.eye(4, dtype=bool)
    gaps = np.where(others, nodes[:, :, None] - nodes[:, None, :], 1.0).prod(axis=2)
    weights = -2 * np.where(others, nodes[:, None, :], 0.0).sum(axis=2) / gaps
    return np.einsum("nj,...njd->...nd", weights, path[..., window, :])


def speed(path: Any, ts: Any) -> np.ndarray:
    """Measure the tangential speed |dp/dt| by the differences of `velocity`.

    Arguments: as `velocity`. Returns: speeds [m/s], (..., N). Raises: as `velocity`.
    """
    return np.linalg.norm(velocity(path, ts), axis=-1)


def curvature(path: Any, ts: Any, *, velocities: Any = None, floor: float = 0.01) -> np.ndarray:
    """Measure the signed curvature of a path, positive where it turns to the left.

    kappa = (x' y'' - y' x'') / v^3,    v^2 = x'^2 + y'^2

    Arguments:
        path: positions [m], (..., N, 2), N at least 4.
        ts: times [s], (N,), increasing.
        velocities: exact velocities [m/s] of the shape of `path`, where they are known, as those
            of a simulated hand are: they are then differentiated once instead of the path twice.
        floor: fraction of a record's largest speed; where the hand is slower, the curvature is a
            quotient of round-off and comes back as NaN.
    Returns: curvatures [1/m], (..., N).
    Raises: as `velocity`, and ValueError for a floor outside [0, 1).
    """
    path, ts = _path_and_instants(path, ts, 4)
    floor = _samples.fraction("floor", floor)
    if velocities is None:
        v, a = velocity(path, ts), acceleration(path, ts)
    else:
        v = _samples.path("velocities", velocities, 4)
        if v.shape != path.shape:
            raise ValueError(f"velocities: shape {v.shape} given, wanted {path.shape} as `path`")
        a = velocity(v, ts)
    pace = np.linalg.norm(v, axis=-1)
    fastest = np.max(pace, axis=-1, keepdims=True, where=np.isfinite(pace), initial=0.0)
    moving = (pace > 0) & (pace >= floor * fastest)
    turn = v[..., 0] * a[..., 1] - v[..., 1] * a[..., 0]
    return np.where(moving, turn / np.where(moving, pace, 1.0) ** 3, np.nan)


def path_length(path: Any) -> np.ndarray:
    """Add up the distances between successive samples.

    Arguments:
        path: positions [m], (..., N, 2), N at least 2.
    Returns: lengths [m], (...,), NaN for a record with a gap.
    Raises: ValueError for a wrong shape, too few samples or no finite sample.
    """
    steps = np.diff(_samples.path("path", path, 2), axis=-2)
    return np.linalg.norm(steps, axis=-1).sum(axis=-1)


def deviation(path: Any) -> np.ndarray:
    """Find how far a path strays from the straight line through its first and last sample.

    Arguments:
        path: positions [m], (..., N, 2), N at least 3.
    Returns: the perpendicular distance of largest magnitude [m], (...,): positive to the left of
        the direction from the first sample to the last, negative to the right; NaN for a record
        with a gap.
    Raises: ValueError for a wrong shape, too few samples, no finite sample, or a path that ends
        where it began and so has no such line.
    """
    path = _samples.path("path", path, 3)
    offsets = path - path[..., :1, :]
    chord = offsets[..., -1, :]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    if (length == 0).any():
        raise ValueError("path: a first and a last sample that differ are wanted, got the same")
    left = np.stack([-chord[..., 1], chord[..., 0]], axis=-1) / length
    distances = (offsets * left[..., None, :]).sum(axis=-1)
    farthest = np.abs(distances).argmax(axis=-1)  # of a gap, where there is one
    return np.take_along_axis(distances, farthest[..., None], axis=-1)[..., 0]


def path_distance(path: Any, other: Any, *, num_samples: int = 101) -> np.ndarray:
    """Measure how far two paths lie apart in space, whenever they are passed.

    d = sqrt(mean_s |a(s) - b(s)|^2), with s the fraction of each path's own length.

    Arguments:
        path, other: positions [m], (N, 2) and (M, 2), N and M at least 2, in the same direction.
        num_samples: points, evenly spaced along each path, of which the mean is taken.
    Returns: the root mean square distance [m], ().
    Raises: ValueError for a wrong shape, a gap, too few samples, or a path of no length.
    """
    along = []
    for name, value in (("path", path), ("other", other)):
        points = _samples.all_finite(name, _samples.path(name, value, 2))
        if points.ndim != 2:
            raise ValueError(f"{name}: one path (N, 2) is wanted, got shape {points.shape}")
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        length = np.concatenate([[0.0], np.cumsum(steps)])
        if not length[-1] > 0:
            raise ValueError(f"{name}: a path of some length is wanted, got one that stands still")
        s = np.linspace(0, 1, num_samples)
        fraction = length / length[-1]
        along.append(np.stack([np.interp(s, fraction, column) for column in points.T], axis=1))
    return np.sqrt(np.mean(np.sum((along[0] - along[1]) ** 2, axis=1)))


def clearance(path: Any, centre: Any, radius: Any) -> np.ndarray:
    """Find how close a path comes to a disc, between its samples too.

    min over the segments between successive samples of |e - e_ob|, less r_ob: what a path sampled
    at 10 ms bulges out beyond its segments is h^2/(8 R) for segments of length h and a radius of
    curvature R, 0.1 mm for 5 mm and 3 cm.

    Arguments:
        path: positions [m], (..., N, 2), N at least 2.
        centre, radius: of the disc [m], (2,) and ().
    Returns: the least distance from the rim [m], (...,), negative inside; NaN with a gap.
    Raises: ValueError for a wrong shape, too few samples or no finite sample.
    """
    path = _samples.path("path", path, 2)
    centre = _samples.shaped("centre", centre, (2,), "(2,)")
    radius = _samples.shaped("radius", radius, (), "()")
    begin, step = path[..., :-1, :] - centre, np.diff(path, axis=-2)
    squared = (step**2).sum(axis=-1)
    along = -(begin * step).sum(axis=-1) / np.where(squared > 0, squared, 1.0)
    nearest = begin + np.clip(along, 0.0, 1.0)[..., None] * step
    return np.linalg.norm(nearest, axis=-1).min(axis=-1) - radius


def movement_interval(
    ts: Any, speed: Any, *, threshold: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Find when a movement begins and ends.

    Arguments:
        ts: times [s], (N,), N at least 3, increasing.
        speed: speeds [m/s], (..., N).
        threshold: fraction of a record's peak speed; 0.05 is our choice.
    Returns: onset and end [s], each (...,): the times at which the speed first rises above and
        last falls below the threshold, interpolated linearly between samples; the first or last
        time where the speed is above it there already; NaN for a record with a gap.
    Raises: ValueError for a wrong shape, too few samples, times that do not increase, negative
        speeds, a record without movement, or a threshold outside [0, 1).
    """
    ts = _samples.instants(ts, 3)
    speed = _samples.speeds(speed, ts.size)
    level = _samples.fraction("threshold", threshold) * speed.max(axis=-1, keepdims=True)
    whole = np.isfinite(speed).all(axis=-1)

    def rise(ts: np.ndarray, speed: np.ndarray) -> np.ndarray:
        above = (speed > level).argmax(axis=-1, keepdims=True)
        below = np.maximum(above - 1, 0)
        high, low = (np.take_along_axis(speed, i, axis=-1) for i in (above, below))
        gap = np.where(above > 0, high - low, 1.0)
        share = np.where(above > 0, (level - low) / gap, 0.0)
        return np.where(whole, (ts[below] + share * (ts[above] - ts[below]))[..., 0], np.nan)

    return rise(ts, speed), rise(ts[::-1], speed[..., ::-1])


def symmetry(ts: Any, speed: Any, *, threshold: float = 0.05) -> np.ndarray:
    """Measure what fraction of a movement passes before its highest peak of speed.

    (t_peak - t_onset) / (t_end - t_onset): 0.5 for a minimum-jerk movement, less for one that
    speeds up faster than it slows down. The peak is that of the parabola through three samples.

    Arguments: as `movement_interval`.
    Returns: fractions (...,), NaN for a record with a gap. Raises: as `movement_interval`.
    """
    onset, end = movement_interval(ts, speed, threshold=threshold)
    ts, speed = np.asarray(ts, float), np.asarray(speed, float)
    rows = speed.reshape(-1, ts.size)
    peaks = np.array([vertex(ts, row, int(row.argmax()))[0] for row in rows])
    return (peaks.reshape(speed.shape[:-1]) - onset) / (end - onset)
