"""Recorded movements: read, checked, brought to one rate and freed of high-frequency noise."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray
from scipy.interpolate import Akima1DInterpolator
from scipy.signal import butter, sosfiltfilt

_COLUMNS = ("trial", "time", "x", "y")
_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # in metres
_SECONDS = ("s", "second", "seconds")
_NETCDF = (".nc", ".nc4", ".cdf", ".netcdf")
_FEWEST = 10  # samples of a trial, recorded and resampled
_NAMED = 5  # unfit trials named in one error


def load_movements(
    source: str | Path | xarray.Dataset,
    *,
    length_unit: str = "m",
    rate: float = 100.0,
    cutoff: float | None = 10.0,
    order: int = 4,
    max_gap: float = 0.05,
) -> xarray.Dataset:
    """Load recorded movements of the hand, resampled to one rate and low-pass filtered.

    Each trial is interpolated on a uniform grid by modified Akima splines: they are local and
    hardly overshoot between noisy samples, and across gaps they err less than cubic splines and
    PCHIP. The grid is at least as fine as the recording, so that noise is filtered out before it
    can fold into slow movement; only then is it thinned out to `rate`. The filter is a Butterworth
    filter of half the order, run forwards and backwards: no delay, and a gain of 1/sqrt(2) at
    `cutoff` for both passes together (Robertson & Dowling 2003, J. Electromyogr. Kinesiol. 13;
    the usual correction). Beyond its ends a trial is continued by its mirror image through a point,
    the end of a parabola fitted to one period of the cut-off: rest stays rest, steady motion goes
    on, and one noisy sample does not decide the first velocity.

    Samples whose x or y is not finite are dropped: at the ends they shorten the trial; within it
    the interpolation spans them. Where samples lie further apart than `max_gap`, the trial is
    refused, not guessed.

    Arguments:
        source: path of a CSV file with the columns trial, time, x and y, one sample in each row,
            and comments from '#' on; or of a netCDF file (.nc, .nc4, .cdf, .netcdf); or a Dataset.
            A Dataset has either x and y with the dimensions (trial, time), or `hand` (trial, time,
            axis), NaN where a trial is over, or else long form: trial, time, x and y, all of shape
            (samples,). Times are in seconds from any origin; other columns and variables are
            ignored.
        length_unit: unit of the recorded positions: "m", "cm" or "mm".
        rate: samples per second of the result [Hz].
        cutoff: cut-off frequency [Hz], below half of `rate` and of the recorded rates; None leaves
            the positions unfiltered. 10 Hz keeps the peak speed of a minimum-jerk reach of 0.3 s
            within 0.5 %; noise of 0.3 mm at 200 Hz then scatters that of one reach by 1 %.
        order: order of both passes together, even.
        max_gap: longest time between two samples that is interpolated [s]. Over 50 ms without a
            sample, with 0.3 mm of noise, the peak speed of a reach of 10 cm in 0.5 s errs by 2 %.

    Returns: Dataset with `hand` (trial, time, axis) [m], NaN after the end of a trial; `duration`
    (trial,) [s], from its first to its last finite sample; and the coordinates trial (as in the
    source, in order of appearance), time [s] from the first sample, and axis ("x", "y"). The
    measures take one trial without its NaN at a time:

        for name, ts, path in trials(data):
            print(name, speed(path, ts).max(), symmetry(ts, speed(path, ts)), deviation(path))

    Raises: TypeError for another source; FileNotFoundError. ValueError naming the argument that
    does not fit, a file that is empty or something else, a missing column, and the trials whose
    times are not finite or do not increase, that have fewer than 10 samples or a longer gap, or
    were recorded too slowly for `cutoff`.
    """
    _check_numbers(rate, cutoff, order, max_gap)
    if length_unit not in _LENGTHS:
        raise ValueError(f"length_unit: got {length_unit!r}, wanted one of {list(_LENGTHS)}")
    table = _table(source, length_unit)
    names, spans, hands, unfit = [], [], [], []
    for name, rows in table.groupby("trial", sort=False):
        try:
            ts, points = _samples(rows, max_gap)
            hand = _resampled(ts, _LENGTHS[length_unit] * points, rate, cutoff, order)
        except ValueError as error:
            unfit.append(f"trial {name}: {error}")
            continue
        names.append(name)
        spans.append(ts[-1])
        hands.append(hand)
    if unfit:
        more = f"; and {len(unfit) - _NAMED} more" if len(unfit) > _NAMED else ""
        raise ValueError(
            f"source: {len(unfit)} of {len(unfit) + len(names)} trials cannot be used: "
            + "; ".join(unfit[:_NAMED])
            + more
        )
    return _dataset(names, np.array(spans), hands, rate)


def trials(data: xarray.Dataset) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
    """Go through the trials of `load_movements`, each without what lies after its end.

    Arguments:
        data: Dataset with `hand` (trial, time, axis) [m], NaN after the end of a trial.
    Returns: for each trial its name, its times [s], (N,), and its path [m], (N, 2).
    Raises: ValueError for a Dataset without these.
    """
    if "hand" not in data or data.hand.dims != ("trial", "time", "axis"):
        raise ValueError("data: `hand` (trial, time, axis) is wanted, as load_movements returns it")
    for name, path in zip(data.trial.values, data.hand.values, strict=True):
        last = np.flatnonzero(np.isfinite(path).all(axis=1))
        count = int(last[-1]) + 1 if last.size else 0
        yield name, data.time.values[:count], path[:count]


def _check_numbers(rate: float, cutoff: float | None, order: int, max_gap: float) -> None:
    """Raise ValueError naming the number that does not fit."""
    for name, value, unit in (("rate", rate, "Hz"), ("max_gap", max_gap, "s")):
        if not 0 < value < np.inf:
            raise ValueError(f"{name}: got {value}, wanted a positive number [{unit}]")
    if cutoff is not None and not 0 < cutoff < rate / 2:
        raise ValueError(
            f"cutoff: got {cutoff:g} Hz, wanted more than 0 and less than {rate / 2:g} Hz, half "
            "of `rate`; or None"
        )
    if order != int(order) or order < 2 or order % 2:
        raise ValueError(f"order: got {order}, wanted an even number from 2, for two equal passes")


def _table(source: str | Path | xarray.Dataset, length_unit: str) -> pd.DataFrame:
    """Return the samples in long form: columns trial, and time, x and y as floats."""
    if isinstance(source, str | Path):
        found = _opened(Path(source))
        if isinstance(found, pd.DataFrame):
            return _as_numbers(found)
        source = found
    if not isinstance(source, xarray.Dataset):
        raise TypeError(f"source: got {type(source).__name__}, wanted a path or an xarray.Dataset")
    _check_units(source, length_unit)
    return _as_numbers(_long_form(source))


def _opened(path: Path) -> pd.DataFrame | xarray.Dataset:
    """Return what a file holds: a table with the four columns, or a Dataset.

    Raises FileNotFoundError, or ValueError, naming the path, for what is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"source: there is no file {path}")
    netcdf = path.suffix.lower() in _NETCDF
    if not path.stat().st_size:
        raise ValueError(f"source: the file {path} is empty; record or export it again")
    try:
        if netcdf:
            return xarray.load_dataset(path, decode_times=False, decode_timedelta=False)
        table = pd.read_csv(path, comment="#", skipinitialspace=True)
        _require([str(column) for column in table.columns])
    except Exception as error:
        kind, reason = "netCDF" if netcdf else "CSV", str(error).removeprefix("source: ")
        raise ValueError(
            f"source: {path} cannot be read as {kind}: {reason.splitlines()[0]:.200}. Export a CSV "
            "file with the columns trial, time, x and y, separated by commas, or netCDF with the "
            "ending .nc"
        ) from error
    return table


def _require(names: list) -> None:
    """Raise ValueError unless the four columns are among the names."""
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        got = ", ".join(repr(name) if not str(name).isprintable() else str(name) for name in names)
        raise ValueError(f"source: {', '.join(missing)} missing; got {got:.200}")


def _as_numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the four columns, time, x and y as floats."""
    trials: Any = table["trial"]
    if not len(trials) or trials.isna().any():
        raise ValueError("source: at least one sample, each with a trial, is wanted")
    numbers = {}
    for name in _COLUMNS[1:]:
        column: Any = table[name]
        if not pd.api.types.is_numeric_dtype(column):
            raise ValueError(f"source: {name} must hold numbers, got {column.dtype}")
        numbers[name] = column.astype(float)
    return pd.DataFrame({"trial": trials, **numbers})


def _check_units(data: xarray.Dataset, length_unit: str) -> None:
    """Raise ValueError where a unit that the Dataset states is not the one assumed."""
    for name in {"time", "hand", "x", "y"} & set(data.variables):
        wanted = _SECONDS if name == "time" else (length_unit,)
        got = data[name].attrs.get("units", wanted[0])
        if got not in wanted:
            hint = "" if name == "time" else "; say so by `length_unit`"
            raise ValueError(f"source: {name} is in {got!r}, wanted {wanted[0]!r}{hint}")


def _long_form(data: xarray.Dataset) -> pd.DataFrame:
    """Return the samples of a Dataset in long form, with the four columns at least."""
    if "hand" in data:
        hand = data["hand"]
        if set(hand.dims) != {"trial", "time", "axis"} or hand.sizes["axis"] != 2:
            raise ValueError(
                f"source: hand has the dimensions {dict(hand.sizes)}, wanted trial, time and axis, "
                "two of the last"
            )
        names = ("x", "y") if "axis" in hand.coords else (0, 1)
        x, y = (hand.sel(axis=name, drop=True) for name in names)
        data = data.assign(x=x, y=y)
    _require([*data.variables, *({"trial"} & set(data.dims))])
    grid = {"trial", "time"}
    wide = grid <= set(data.dims)
    for name in _COLUMNS:
        dims = set(data[name].dims)
        wanted = ({name} if name in grid else grid) if wide else set(data["x"].dims[:1])
        if dims != wanted:
            raise ValueError(
                f"source: {name} has the dimensions {data[name].dims}, wanted x and y (trial, "
                "time), or all of trial, time, x and y (samples,)"
            )
    return data[[name for name in _COLUMNS if name not in data.dims]].to_dataframe().reset_index()


def _samples(rows: pd.DataFrame, max_gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,) [s] from the first finite sample on and the positions (n, 2)."""
    ts = rows["time"].to_numpy()
    points = rows[["x", "y"]].to_numpy()
    if not np.isfinite(ts).all():
        raise ValueError("every time must be finite")
    late = np.flatnonzero(np.diff(ts) <= 0)
    if len(late):
        before, after = ts[late[0]], ts[late[0] + 1]
        raise ValueError(f"times must increase, but {after:g} s follows {before:g} s")
    finite = np.isfinite(points).all(axis=1)
    ts, points = ts[finite], points[finite]
    if len(ts) < _FEWEST:
        raise ValueError(f"{len(ts)} finite samples, wanted at least {_FEWEST}")
    steps = np.diff(ts)
    if steps.max() > max_gap * (1 + 1e-6):  # times are rounded when they are written
        raise ValueError(
            f"no sample for {steps.max():.4g} s from {ts[steps.argmax()]:g} s on, longer than "
            f"max_gap, {max_gap:g} s"
        )
    return ts - ts[0], points


def _resampled(
    ts: np.ndarray, points: np.ndarray, rate: float, cutoff: float | None, order: int
) -> np.ndarray:
    """Return the positions (count, 2) at 0, 1 / rate, ... up to the last of the times (n,)."""
    recorded = 1 / np.median(np.diff(ts))
    if cutoff is not None and cutoff >= recorded / 2:
        raise ValueError(f"recorded at {recorded:.4g} Hz, too slowly for a cutoff of {cutoff:g} Hz")
    count = int(ts[-1] * rate + 1e-6) + 1
    if count < _FEWEST:
        raise ValueError(f"lasts {ts[-1]:g} s, wanted at least {_FEWEST} samples at {rate:g} Hz")
    parts = 1 if cutoff is None else max(1, round(np.ceil(recorded / rate)))
    grid = np.arange((count - 1) * parts + 1) / (rate * parts)
    smooth = Akima1DInterpolator(ts, points, method="makima")(np.minimum(grid, ts[-1]))
    if cutoff is not None:
        smooth = _low_pass(smooth, rate * parts, cutoff, order)
    return smooth[::parts]


def _low_pass(points: np.ndarray, rate: float, cutoff: float, order: int) -> np.ndarray:
    """Return positions (n, 2), sampled at `rate` [Hz], without what is faster than `cutoff`.

    Two passes of gain 1/sqrt(1 + (w/w1)^order) have one of 1/sqrt(2) at w = w1 (sqrt(2) -
    1)^(1/order); w = tan(pi f / rate) is the frequency warped as the digital filter does.
    """
    warped = np.tan(np.pi * cutoff / rate) / (np.sqrt(2) - 1) ** (1 / order)
    sections = butter(order // 2, np.arctan(warped) * rate / np.pi, fs=rate, output="sos")
    period = min(len(points), max(4, round(rate / cutoff) + 1))
    pad = min(len(points) - 1, 2 * period)
    first, last = (_end(points[::step][:period]) for step in (1, -1))
    before = 2 * first - points[pad:0:-1]
    after = 2 * last - points[-2 : -pad - 2 : -1]
    padded = np.concatenate([before, points, after])
    return sosfiltfilt(sections, padded, axis=0, padlen=0)[pad:-pad]


def _end(points: np.ndarray) -> np.ndarray:
    """Return where a parabola fitted to the points (n, 2) has the first of them, (2,)."""
    return np.polynomial.polynomial.polyfit(np.arange(len(points)), points, 2)[0]


def _dataset(
    names: list, spans: np.ndarray, hands: list[np.ndarray], rate: float
) -> xarray.Dataset:
    """Return the result: the trials (count, 2) on one time axis, NaN after their ends."""
    padded = np.full((len(hands), max(map(len, hands)), 2), np.nan)
    for row, hand in zip(padded, hands, strict=True):
        row[: len(hand)] = hand
    ts = np.arange(padded.shape[1]) / rate

    def attributes(long_name: str, units: str) -> dict[str, str]:
        return {"long_name": long_name, "units": units}

    return xarray.Dataset(
        {
            "hand": (("trial", "time", "axis"), padded, attributes("position of the hand", "m")),
            "duration": ("trial", spans, attributes("duration of the recording", "s")),
        },
        coords={
            "trial": ("trial", names, attributes("trial", "1")),
            "time": ("time", ts, attributes("time from the first sample", "s")),
            "axis": ("axis", ["x", "y"], attributes("axis of the workspace", "1")),
        },
    )
