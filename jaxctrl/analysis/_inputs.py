"""What the analyses accept: real arrays checked for shape, instants that increase, fractions."""

from typing import Any

import numpy as np


def numbers(name: str, value: Any, wanted: str) -> np.ndarray:
    """Return `value` as a float array; ValueError for ragged, complex or non-numeric input."""
    try:
        array = np.asarray(value)
        if np.iscomplexobj(array):
            raise TypeError
        return array.astype(float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: real numbers of shape {wanted} are wanted") from None


def shaped(
    name: str, value: Any, tail: tuple[int | None, ...], wanted: str, *, batched: bool = True
) -> np.ndarray:
    """Return `value` as a float array whose last axes are `tail`; None stands for any size from 1.

    Raises ValueError for another shape, for leading axes where `batched` is false, and where no
    sample at all is finite. Single samples that are not finite become NaN.
    """
    array = numbers(name, value, wanted)
    axes = array.shape[max(array.ndim - len(tail), 0) :]
    fits = len(axes) == len(tail) and all(
        size == want if want is not None else size > 0
        for size, want in zip(axes, tail, strict=True)
    )
    if not fits or not array.size or (not batched and array.ndim > len(tail)):
        raise ValueError(f"{name}: shape {array.shape} given, wanted {wanted}")
    finite = np.isfinite(array)
    if not finite.any():
        raise ValueError(f"{name}: no finite sample in shape {array.shape}")
    array[~finite] = np.nan
    return array


def path(name: str, value: Any, fewest: int) -> np.ndarray:
    """Return paths (..., N, 2) with N at least `fewest`."""
    array = shaped(name, value, (None, 2), "(..., N, 2)")
    if array.shape[-2] < fewest:
        raise ValueError(f"{name}: at least {fewest} samples are wanted, got {array.shape[-2]}")
    return array


def instants(value: Any, fewest: int) -> np.ndarray:
    """Return `ts` (N,), at least `fewest` of them, finite and increasing."""
    ts = shaped("ts", value, (None,), "(N,)", batched=False)
    if ts.size < fewest:
        raise ValueError(f"ts: at least {fewest} samples are wanted, got {ts.size}")
    if not np.isfinite(ts).all() or not (np.diff(ts) > 0).all():
        raise ValueError("ts: finite times that increase are wanted")
    return ts


def speeds(value: Any, length: int, *, batched: bool = True) -> np.ndarray:
    """Return `speed` (..., length); ValueError where one is negative or a record is all zero."""
    wanted = f"(..., {length})" if batched else f"({length},)"
    speed = shaped("speed", value, (length,), f"{wanted}, as long as `ts`", batched=batched)
    if (speed < 0).any():
        raise ValueError(f"speed: at least 0 is wanted, got {np.nanmin(speed)}")
    if (speed == 0).all(axis=-1).any():
        raise ValueError("speed: a movement is wanted, got zero everywhere")
    return speed


def fraction(name: str, value: float, *, below: float = 1.0) -> float:
    """Return `value` where it lies in [0, below); ValueError elsewhere, NaN included."""
    if not 0 <= value < below:
        raise ValueError(f"{name}: a fraction from 0 to below {below:g} is wanted, got {value}")
    return float(value)


def positive(name: str, value: Any, wanted: str) -> np.ndarray:
    """Return `value` as a float array in which every number is finite and above 0."""
    array = numbers(name, value, wanted)
    if not array.size or not np.isfinite(array).all() or not (array > 0).all():
        raise ValueError(f"{name}: finite numbers above 0 are wanted, got {value}")
    return array


def all_finite(name: str, array: np.ndarray) -> np.ndarray:
    """Return `array`, or raise ValueError where a sample is not finite."""
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name}: finite numbers are wanted; leave out or fill the gaps first "
            "(`analysis.trials` leaves out what lies after the end of a loaded trial)"
        )
    return array
