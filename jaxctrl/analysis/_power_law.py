"""The two-thirds power law of speed and curvature, and what smoothed noise does by itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import butter, correlate, sosfiltfilt

from .. import _samples
from ._kinematics import curvature as measure_curvature, speed as measure_speed

STRAIGHT = 1.0
"""Curvature [1/m] up to which samples count as straight by default.

Its radius of 1 m is longer than an arm: a hand that swings about the shoulder bends more. Ellipses
the size of a hand have 5 to 50 / m throughout.
"""

_FEWEST = 10
_RESAMPLES = 2000
_ORDER = 4


@dataclass(frozen=True)
class PowerLaw:
    """The law v = gain r^exponent, fitted.

    Fields:
        exponent: 1/3 by the two-thirds power law, 0 at constant speed.
        gain: geometric mean of v / r^exponent [m^(1 - exponent)/s].
        r_squared: share of the variance of log v within records that the law explains; NaN where
            the speed is constant, so that there is nothing to explain.
        interval: 95 % bootstrap interval of the exponent, (lower, upper).
        num_samples: how many samples were used.
    """

    exponent: float
    gain: float
    r_squared: float
    interval: tuple[float, float]
    num_samples: int


@dataclass(frozen=True, eq=False)
class PowerLawNull:
    """What scribbles of smoothed noise give: mean and standard deviation of the exponents (n,)."""

    mean: float
    sd: float
    exponents: np.ndarray


def power_law(
    speed: Any, curvature: Any, *, straight: float = STRAIGHT, trim: float = 0.05, seed: int = 0
) -> PowerLaw:
    """Fit the power law of speed and radius of curvature.

    omega = c kappa^(2/3)  <=>  v = c r^(1/3),  r = 1 / |kappa|
                               (Lacquaniti, Terzuolo & Viviani 1983; Li 2006, eq. 3.25-3.26)

    The exponent is the slope of log v over log r by least squares. The form omega over kappa is
    not used: omega = v |kappa| has kappa on both sides, which inflates R^2 even for noise. Each
    record has a gain of its own, since that changes with tempo and size; the exponent is common.

    An exponent near 1/3 is no evidence by itself: compare it with `power_law_null` for the same
    `straight`, `trim` and speed floor. Smoothed noise gives 2/7 where nothing is left out, 0.36
    with the defaults of both, and 0.21 where only samples below a tenth of the largest speed are
    left out.

    The interval allows for samples that depend on their neighbours. One record is resampled in
    moving blocks (Künsch 1989), twice as long as the lag at which the autocorrelation of log r
    first falls to zero: a quarter of a cycle of an ellipse. For scribbles and for ellipses with
    fluctuating speed it held the true exponent in 92 to 100 % of the trials. Several records are
    resampled whole; with fewer than about eight the interval is too short.

    Arguments:
        speed: v [m/s], (N,), or (trials, N), or a list of arrays (N_i,).
        curvature: kappa [1/m], of the same shapes, signed or not.
        straight: samples with |kappa| up to this [1/m] are left out: log r is infinite in an
            inflection. Samples that are not finite or at rest are left out too.
        trim: fraction of each record's samples that is left out at its beginning and as much at
            its end; 0.05 is our choice. At least 0 and below 0.5.
        seed: of the bootstrap; the same seed gives the same interval.
    Returns: `PowerLaw`. Noise in the measured positions biases the exponent: filter them first.
    Raises: ValueError for shapes that do not fit, negative speeds, a negative or infinite
        `straight`, a `trim` outside [0, 0.5), a record with fewer than 10 samples left, or a
        radius of curvature that does not vary, as on a circle.
    """
    records = _logarithms(speed, curvature, straight, trim)
    sums = np.array([_centred_sums(record) for record in records])
    sxx, sxy, syy = sums.sum(axis=0)
    log_r, log_v = np.concatenate(records, axis=1)
    exponent = sxy / _varying(sxx, log_r.size)
    rng = np.random.default_rng(seed)
    resampled = _resample_blocks(records[0], rng) if len(records) == 1 else _resample(sums, rng)
    lower, upper = np.percentile(resampled, [2.5, 97.5])
    return PowerLaw(
        exponent=float(exponent),
        gain=float(np.exp((log_v - exponent * log_r).mean())),
        r_squared=float(exponent * sxy / syy) if syy > 1e-24 * log_v.size else np.nan,
        interval=(float(lower), float(upper)),
        num_samples=log_r.size,
    )


def least_jerk_exponent(frequency: Any) -> np.ndarray:
    """Return the exponent of the radius of curvature under least jerk, for one kind of shape.

    beta(nu) = (2/3) (1 + nu^2/2) / (1 + nu^2 + nu^4/15)    (Huh & Sejnowski 2015, PNAS 112, E3950)

    It is that of paths whose log curvature oscillates slightly, as cos(nu theta) over the angle
    theta of the tangent, once their timing is that of least jerk: v ~ r^beta. It falls from 2/3 of
    a logarithmic spiral, nu = 0, over 0.330 of an ellipse near the circle, nu = 2, towards 0.

    Arguments:
        frequency: nu, cycles of the log curvature while the tangent turns by 2 pi; of any shape.
    Returns: beta, of the same shape.
    Raises: ValueError for a frequency that is negative or not finite.
    """
    nu = _samples.numbers("frequency", frequency, "()")
    if not np.isfinite(nu).all() or (nu < 0).any():
        raise ValueError(f"frequency: finite numbers from 0 are wanted, got {frequency}")
    return np.asarray((2 / 3) * (1 + nu**2 / 2) / (1 + nu**2 + nu**4 / 15))


def power_law_null(
    duration: float,
    rate: float,
    cutoff: float,
    *,
    extent: float = 0.1,
    floor: float = 0.01,
    straight: float = STRAIGHT,
    trim: float = 0.05,
    num_seeds: int = 100,
) -> PowerLawNull:
    """Measure the exponent of scribbles that are nothing but smoothed noise.

    White Gaussian noise in x and y is low-pass filtered (Butterworth of order 4, forwards and
    backwards) and goes through `speed`, `curvature` and the estimator of `power_law`. That noise
    obeys a power law is the point of Maoz, Portugaly, Flash & Weiss (2006).

    For a stationary Gaussian scribble with nothing left out the exponent is 2/7 = 0.286 whatever
    the filter, since velocity and normal acceleration are then independent: with
    log |kappa| = log |a_n| - 2 log v, var(log v) = pi^2/24 and var(log |a_n|) = pi^2/8,
    the slope is 2 var(log v) / (4 var(log v) + var(log |a_n|)). Leaving out samples changes it:
    compare data with the null for the same rules.

    Arguments:
        duration, rate: length of a scribble [s] and its samples per second [1/s].
        cutoff: where the filter's gain falls to 1/2 [Hz]. At least 5 cycles of it are wanted in
            the duration, and at least 5 samples in each.
        extent: RMS distance [m] of the samples from their mean, which sets the scale of kappa;
            0.1 is our choice. Give that of your data.
        floor: as in `curvature`.
        straight, trim: as in `power_law`.
        num_seeds: how many scribbles, from the seeds 0, 1, ...; at least 2.
    Returns: `PowerLawNull`. Its standard deviation is that of single scribbles.
    Raises: ValueError for an argument that is not finite and above 0 or out of its range.
    """
    for name, value in {
        "duration": duration,
        "rate": rate,
        "cutoff": cutoff,
        "extent": extent,
    }.items():
        _samples.positive(name, value, "()")
    if cutoff * duration < 5 or rate < 5 * cutoff:
        raise ValueError(
            f"cutoff: from 5 / duration = {5 / duration:g} Hz to rate / 5 = {rate / 5:g} Hz is "
            f"wanted, got {cutoff:g}"
        )
    if num_seeds < 2:
        raise ValueError(f"num_seeds: at least 2 are wanted, got {num_seeds}")
    ts = np.arange(round(duration * rate)) / rate
    margin = round(5 * rate / cutoff)  # where the filter starts and ends; cut off again
    smooth = butter(_ORDER, cutoff, fs=rate, output="sos")
    exponents = np.empty(num_seeds)
    for seed in range(num_seeds):
        noise = np.random.default_rng(seed).standard_normal((ts.size + 2 * margin, 2))
        path = sosfiltfilt(smooth, noise, axis=0)[margin:-margin]
        path -= path.mean(axis=0)
        path *= extent / np.sqrt((path**2).sum(axis=1).mean())
        kappa = measure_curvature(path, ts, floor=floor)
        (record,) = _logarithms(measure_speed(path, ts), kappa, straight, trim)
        sxx, sxy, _ = _centred_sums(record)
        exponents[seed] = sxy / _varying(sxx, record.shape[1])
    return PowerLawNull(float(exponents.mean()), float(exponents.std(ddof=1)), exponents)


def _records(name: str, value: Any) -> Sequence[np.ndarray]:
    """Return one array (N_i,) for each record."""
    wanted = "(N,), (trials, N) or a list of (N,)"
    if isinstance(value, list | tuple) and value and np.ndim(value[0]) == 1:
        entries = [
            _samples.shaped(f"{name}[{i}]", entry, (None,), "(N,)") for i, entry in enumerate(value)
        ]
    else:
        array = _samples.shaped(name, value, (None,), wanted, batched=True)
        if array.ndim > 2:
            raise ValueError(f"{name}: shape {array.shape} given, wanted {wanted}")
        entries = list(np.atleast_2d(array))
    return entries


def _logarithms(speed: Any, curvature: Any, straight: float, trim: float) -> list[np.ndarray]:
    """Return log r and log v (2, n_i) of the samples to be used, for each record."""
    if not 0 <= straight < np.inf:
        raise ValueError(f"straight: a curvature [1/m] of at least 0 is wanted, got {straight}")
    trim = _samples.fraction("trim", trim, below=0.5)
    speeds, curvatures = _records("speed", speed), _records("curvature", curvature)
    shapes = [len(v) for v in speeds], [len(k) for k in curvatures]
    if shapes[0] != shapes[1]:
        raise ValueError(f"curvature: records of {shapes[1]} samples given, wanted {shapes[0]}")
    return [
        _logarithms_of_one(i, v, np.abs(kappa), straight, trim)
        for i, (v, kappa) in enumerate(zip(speeds, curvatures, strict=True))
    ]


def _logarithms_of_one(
    record: int, speed: np.ndarray, bend: np.ndarray, straight: float, trim: float
) -> np.ndarray:
    if (speed < 0).any():
        raise ValueError(f"speed: at least 0 is wanted, got {np.nanmin(speed)}")
    cut = int(trim * speed.size)
    inside = slice(cut, speed.size - cut)
    speed, bend = speed[inside], bend[inside]
    used = np.isfinite(speed) & np.isfinite(bend) & (speed > 0) & (bend > straight)
    if used.sum() < _FEWEST:
        raise ValueError(
            f"curvature: at least {_FEWEST} samples are wanted with a finite |kappa| above "
            f"{straight:g} / m, got {used.sum()} in record {record}"
        )
    return np.stack([-np.log(bend[used]), np.log(speed[used])])


def _centred_sums(record: np.ndarray) -> np.ndarray:
    """Return sums of squares and products about the means (3,), xx, xy, yy, of x and y (2, n)."""
    x, y = record - record.mean(axis=1, keepdims=True)
    return np.array([x @ x, x @ y, y @ y])


def _varying(sxx: float, count: int) -> float:
    """Return sxx of log r, or raise ValueError where it is that of a circle."""
    if sxx <= 1e-12 * count:
        raise ValueError("curvature: one that varies is wanted; a circle has any exponent")
    return sxx


def _resample(sums: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the exponents of bootstrap samples of records, given their centred sums (n, 3)."""
    chosen = sums[rng.integers(len(sums), size=(_RESAMPLES, len(sums)))].sum(axis=1)
    return chosen[:, 1] / chosen[:, 0]


def _resample_blocks(record: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the exponents of bootstrap samples of one record, made of moving blocks."""
    x, y = record - record.mean(axis=1, keepdims=True)
    block = _block_length(x)
    running = np.cumsum(np.stack([x, y, x * x, x * y], axis=1), axis=0)
    running = np.concatenate([np.zeros((1, 4)), running])
    blocks = running[block:] - running[:-block]
    number = x.size // block
    chosen = rng.integers(len(blocks), size=(_RESAMPLES, number))
    sx, sy, sxx, sxy = blocks[chosen].sum(axis=1).T
    count = number * block
    return (sxy - sx * sy / count) / (sxx - sx * sx / count)


def _block_length(x: np.ndarray) -> int:
    """Return twice the lag of the first zero of x's autocorrelation, a fifth of it at most."""
    correlation = correlate(x, x, method="fft")[x.size - 1 :]
    lag = int((correlation <= 0).argmax())
    return min(2 * lag, x.size // 5)
