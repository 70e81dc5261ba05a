"""Quantities over time: hand speed, controls, muscle activations, joint angles."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from .. import _samples
from . import _marks
from ._style import COLUMN, drawing, figure_of

_SPEEDS = "(N,), (trials, N) or a list of these"
_TARGET_LINE: dict[str, Any] = {"linestyle": (0, (4, 2.5)), "linewidth": 0.9, "zorder": 1}
_BOUND_LINE: dict[str, Any] = {"linestyle": (0, (1, 1.5)), "linewidth": 0.9, "zorder": 1}
_QUANTITIES = {
    "rad": ("angle", "joint"),
    "rad/s": ("angular velocity", "joint"),
    "m": ("position", "component"),
    "m/s": ("velocity", "component"),
    "N": ("force", "component"),
    "N m": ("torque", "joint"),
}


def speed_profiles(
    ts: Any,
    speeds: Any,
    *,
    labels: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the speed of the hand over time, trials thin and transparent under their mean.

    Arguments:
        ts: times [s], (N,); or a list of such, one for each entry of a list `speeds`.
        speeds: speeds [m/s], (N,); or (trials, N), drawn in one colour with their mean; or a list
            of either, one entry for each colour.
        labels: one name for each entry of the list `speeds`.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, or no finite sample.
    """
    groups = _samples.groups("speeds", speeds, _SPEEDS)
    names = _samples.names_for("labels", labels, len(groups), "entry of `speeds`")
    clocks = _samples.clocks(ts, groups, "speeds")
    with drawing(ax, _size(len(groups))) as axes:
        _marks.draw_over_time(axes, clocks, groups, names)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("hand speed [m/s]")
        _marks.legend(axes)
    return figure_of(axes)


def controls(
    ts: Any,
    us: Any,
    *,
    names: str | Sequence[str] | None = None,
    unit: str = "",
    bounds: Any = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw controls over time as the steps they are: each is held from one instant to the next.

    Arguments:
        ts: times of the states [s], (T + 1,).
        us: controls in `unit`, (T,) or (T, nu); u_k is held from ts[k] to ts[k + 1].
        names: one name for each control.
        unit: unit of the controls, such as "N m"; empty for the dimensionless excitation of a
            muscle.
        bounds: pair (lower, upper) in `unit`, each a number or (nu,), drawn as thin lines; None
            and infinite bounds are not drawn, nor are bounds so wide that the controls would
            fill less than a tenth of the picture.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of names, or no finite sample.
    """
    held = _columns("us", us, "T", "nu")
    steps, nu = held.shape
    clock = _samples.times("ts", ts, steps + 1, f"({steps + 1},), one more than `us`")
    labels = _samples.names_for("names", names, nu, "control")
    if labels is None:
        labels = [f"$u_{{{i + 1}}}$" for i in range(nu)]
    limits = [] if bounds is None else _bounds(bounds, nu)
    with drawing(ax, _size(nu)) as axes:
        colors = []
        for values, label in zip(held.T, labels, strict=True):
            color, dash = _marks.next_look(axes)
            colors.append(color)
            axes.stairs(
                values,
                clock,
                baseline=None,
                color=color,
                linestyle=dash,
                linewidth=matplotlib.rcParams["lines.linewidth"],
                label=label if nu > 1 or names is not None else None,
            )
        for limit in limits:
            _draw_bound(axes, limit, colors, held)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"control [{unit or '–'}]")
        _marks.legend(axes)
    return figure_of(axes)


def activations(
    ts: Any,
    activations: Any,
    *,
    names: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the activations of muscles over time, upwards from zero.

    Arguments:
        ts: times [s], (N,).
        activations: dimensionless, 0 to 1, (N,) or (N, muscles).
        names: one name for each muscle.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of names, or no finite sample.
    """
    values = _columns("activations", activations, "N", "muscles")
    clock = _samples.times("ts", ts, len(values), f"({len(values)},), as long as `activations`")
    labels = _samples.names_for("names", names, values.shape[1], "muscle")
    with drawing(ax, _size(values.shape[1])) as axes:
        _draw_columns(axes, clock, values, labels, "muscle")
        axes.set_xlabel("time [s]")
        axes.set_ylabel("activation [–]")
        if np.nanmin(values) >= 0:
            axes.set_ylim(bottom=0)
        _marks.legend(axes)
    return figure_of(axes)


def trajectories(
    ts: Any,
    values: Any,
    *,
    names: str | Sequence[str] | None = None,
    unit: str,
    targets: Any = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw quantities of one unit over time, such as joint angles, with their targets dashed.

    Arguments:
        ts: times [s], (N,).
        values: in `unit`, (N,) or (N, n).
        names: one name for each column of `values`.
        unit: unit of the values, such as "rad"; it also tells the name of the vertical axis.
        targets: in `unit`, a number or (n,), one dashed line for each column in its colour; a
            NaN draws none.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of names, or no finite sample.
    """
    columns = _columns("values", values, "N", "n")
    length, count = columns.shape
    if np.shape(ts) == (count,) != (length,):
        shape = np.shape(values)
        raise ValueError(
            f"values: shape {shape} given, wanted ({count}, n), as long as `ts`; try .T"
        )
    clock = _samples.times("ts", ts, length, f"({length},), as long as `values`")
    labels = _samples.names_for("names", names, count, "column of `values`")
    goals = None if targets is None else _samples.one_for_each("targets", targets, count)
    quantity, part = _QUANTITIES.get(unit, ("value", "component"))
    with drawing(ax, _size(count)) as axes:
        colors = _draw_columns(axes, clock, columns, labels, part)
        if goals is not None:
            for goal, color in zip(goals, colors, strict=True):
                if np.isfinite(goal):
                    axes.axhline(goal, color=color, **_TARGET_LINE)
            shown = colors[0] if count == 1 else matplotlib.rcParams["text.color"]
            axes.plot([], [], color=shown, label="target", **_TARGET_LINE)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{quantity} [{unit or '–'}]")
        _marks.legend(axes)
    return figure_of(axes)


def _size(count: int) -> tuple[float, float]:
    """Return the figure size [inch]: a journal column, wider where the legend is of columns."""
    return COLUMN + 1.2 * ((count - 1) // 12), 2.1


def _columns(name: str, value: Any, rows: str, columns: str) -> np.ndarray:
    """Return values over time as (rows, columns); a flat array is one column."""
    wanted = f"({rows},) or ({rows}, {columns})"
    array = _samples.samples(name, value, wanted)
    if array.ndim == 1:
        array = array[:, None]
    return _samples.shaped(name, array, (None, None), wanted)


def _draw_columns(
    ax: Axes, clock: np.ndarray, values: np.ndarray, names: list[str] | None, part: str
) -> list[str]:
    """Draw each column of values (N, n) as a curve; returns the colours."""
    count = values.shape[1]
    if names is None and count > 1:
        names = [f"{part} {i + 1}" for i in range(count)]
    lines = [
        ax.plot(clock, column, label=names[i] if names else None)[0]
        for i, column in enumerate(values.T)
    ]
    return [to_hex(line.get_color()) for line in lines]


def _bounds(bounds: Any, nu: int) -> list[np.ndarray]:
    """Return the lower and upper bounds, each (nu,), NaN where there is none."""
    try:
        lower, upper = bounds
    except (TypeError, ValueError):
        raise ValueError("bounds: a pair (lower, upper) is wanted") from None
    return [
        _samples.one_for_each("bounds[0]", lower, nu),
        _samples.one_for_each("bounds[1]", upper, nu),
    ]


def _draw_bound(ax: Axes, limit: np.ndarray, colors: list[str], held: np.ndarray) -> None:
    """Draw the bound (nu,) of every control: one grey line where all have the same."""
    low, high = np.nanmin(held), np.nanmax(held)
    grey = matplotlib.rcParams["grid.color"]
    shared = bool(np.all(limit == limit[0]))
    drawn = False
    for value, color in zip(limit[:1] if shared else limit, colors, strict=False):
        reach = max(high, value) - min(low, value)
        if not np.isfinite(value) or (high > low and high - low < 0.1 * reach):
            continue
        ax.axhline(value, color=grey if shared else color, **_BOUND_LINE)
        drawn = True
    if drawn:
        ax.plot([], [], color=grey, label="bounds", **_BOUND_LINE)
