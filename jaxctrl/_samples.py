"""What the analyses and plots accept: arrays of samples, checked for shape and numbers."""

from collections.abc import Sequence
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


def samples(name: str, value: Any, wanted: str) -> np.ndarray:
    """Return `numbers` as a new array in which samples that are not finite are NaN."""
    array = numbers(name, value, wanted)
    array[~np.isfinite(array)] = np.nan
    return array


def wrong_shape(name: str, got: tuple[int, ...], wanted: str) -> ValueError:
    """Return the error for an array of another shape than wanted."""
    return ValueError(f"{name}: shape {got} given, wanted {wanted}")


def shaped(
    name: str, value: Any, shape: tuple[int | None, ...], wanted: str, *, batched: bool = False
) -> np.ndarray:
    """Return `samples` of a shape, in which None stands for any size from 1.

    With `batched`, any axes may lead. Raises ValueError for another shape, and where no sample at
    all is finite.
    """
    array = samples(name, value, wanted)
    axes = array.shape[max(array.ndim - len(shape), 0) :]
    fits = len(axes) == len(shape) and all(
        size == want if want is not None else size > 0
        for size, want in zip(axes, shape, strict=True)
    )
    if not fits or not array.size or (not batched and array.ndim > len(shape)):
        raise wrong_shape(name, array.shape, wanted)
    if np.isnan(array).all():
        raise ValueError(f"{name}: no finite sample in shape {array.shape}")
    return array


def path(name: str, value: Any, fewest: int) -> np.ndarray:
    """Return paths (..., N, 2) with N at least `fewest`."""
    array = shaped(name, value, (None, 2), "(..., N, 2)", batched=True)
    if array.shape[-2] < fewest:
        raise ValueError(f"{name}: at least {fewest} samples are wanted, got {array.shape[-2]}")
    return array


def instants(value: Any, fewest: int) -> np.ndarray:
    """Return `ts` (N,), at least `fewest` of them, finite and increasing."""
    ts = shaped("ts", value, (None,), "(N,)")
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


def times(name: str, value: Any, length: int | None = None, wanted: str = "(N,)") -> np.ndarray:
    """Return instants [s] as a float array (length,); every one must be finite."""
    array = shaped(name, value, (length,), wanted)
    if np.isnan(array).any():
        raise ValueError(f"{name}: every time must be finite")
    return array


def points(name: str, value: Any, columns: int = 2) -> np.ndarray:
    """Return one point (columns,) or several (n, columns) as the latter.

    There are none for None or an empty list.
    """
    if value is None or np.size(value) == 0:
        return np.zeros((0, columns))
    wanted = f"({columns},) or (n, {columns})"
    array = samples(name, value, wanted)
    if array.ndim not in (1, 2) or array.shape[-1] != columns:
        raise wrong_shape(name, array.shape, wanted)
    if np.isnan(array).all():
        raise ValueError(f"{name}: no finite point in shape {array.shape}")
    return array.reshape(-1, columns)


def one_for_each(name: str, value: Any, count: int) -> np.ndarray:
    """Return a number or (count,) as (count,)."""
    wanted = f"() or ({count},)"
    array = samples(name, value, wanted)
    if array.shape not in ((), (count,)):
        raise wrong_shape(name, array.shape, wanted)
    return np.broadcast_to(array, (count,))


def groups(name: str, value: Any, wanted: str, point: tuple[int, ...] = ()) -> list[np.ndarray]:
    """Return curves as a list of groups, each an array (trials, N, *point).

    An array (N, *point) is one group of one trial, an array (trials, N, *point) is one group, a
    list or tuple of such arrays is several groups. Raises ValueError for anything else, and when
    no group has a finite sample.
    """
    entries, labels = [value], [name]
    if isinstance(value, list | tuple) and value:
        labels = [f"{name}[{i}]" for i in range(len(value))]
        if samples(labels[0], value[0], wanted).ndim > len(point):
            entries = list(value)
        else:
            labels = [name]
    found = [
        _group(label, entry, wanted, point) for label, entry in zip(labels, entries, strict=True)
    ]
    if all(np.isnan(group).all() for group in found):
        raise ValueError(f"{name}: no finite sample")
    return found


def _group(name: str, value: Any, wanted: str, point: tuple[int, ...]) -> np.ndarray:
    """Return one group (trials, N, *point)."""
    array = samples(name, value, wanted)
    curve = 1 + len(point)
    tail_fits = array.shape[array.ndim - len(point) :] == point
    if array.ndim not in (curve, curve + 1) or not tail_fits or not array.size:
        raise wrong_shape(name, array.shape, wanted)
    return array.reshape(-1, *array.shape[array.ndim - curve :])


def clocks(ts: Any, curves: list[np.ndarray], name: str) -> list[np.ndarray]:
    """Return the times (N,) [s] of each group (trials, N): given once for all, or one by one."""
    found = groups("ts", ts, "(N,) or a list of (N,)")
    if len(found) == 1:
        found = found * len(curves)
    if len(found) != len(curves):
        raise ValueError(f"ts: {len(found)} given for {len(curves)} entries of `{name}`")
    return [
        times("ts", clock[0], curve.shape[1], f"({curve.shape[1]},), as long as `{name}`")
        for clock, curve in zip(found, curves, strict=True)
    ]


def names_for(
    argument: str, names: str | Sequence[str] | None, count: int, thing: str
) -> list[str] | None:
    """Return one name for each of `count` things, or None when none were given."""
    if names is None:
        return None
    names = [names] if isinstance(names, str) else [str(name) for name in names]
    if len(names) != count:
        hint = "; pass a list of arrays to label each" if count == 1 else ""
        raise ValueError(
            f"{argument}: {len(names)} given, wanted {count}, one for each {thing}{hint}"
        )
    return names
