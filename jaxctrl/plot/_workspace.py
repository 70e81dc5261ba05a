"""Quantities over the workspace: a map of a scalar, and end points with their ellipses."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from .. import _samples
from . import _marks, _plane
from ._style import drawing, figure_of

_POINTS = "(n, 2) or a list of these"
_RING = _marks.TARGET | {"markersize": 5}  # small, so as not to hide an ellipse


def workspace_map(
    x: Any,
    y: Any,
    values: Any,
    *,
    label: str,
    unit: str,
    diverging: bool = False,
    ax: Axes | None = None,
) -> Figure:
    """Draw a quantity over the workspace as a map in colours, at equal aspect, with a colour bar.

    The colours are perceptually uniform. Points that are not finite, such as those out of reach,
    are grey.

    Arguments:
        x: positions of the columns of the grid [m], (nx,), increasing.
        y: positions of its rows [m], (ny,), increasing.
        values: in `unit`, (ny, nx).
        label: name of the quantity.
        unit: unit of the values; empty for a dimensionless one.
        diverging: whether the sign matters: two hues that meet in white at 0, with limits as far
            below 0 as above.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, positions that do not increase, or no finite value.
    """
    columns, rows = _grid("x", x), _grid("y", y)
    shape = (len(rows), len(columns))
    array = _samples.shaped("values", values, shape, f"{shape}, (ny, nx)")
    corners = np.array([[line[0], line[-1]] for line in (columns, rows)]).T
    with drawing(ax, _plane.size_for(corners, 3, color_bar=True)) as axes:
        length, scale = _plane.length_unit(axes, corners)
        axes.set_aspect("equal", anchor="NW")
        axes.margins(0.0)
        limit = (float(np.nanmax(abs(array))) or 1.0) if diverging else None
        out_of_reach = _marks.tint(axes, matplotlib.rcParams["grid.color"])
        mesh = axes.pcolormesh(
            scale * columns,
            scale * rows,
            np.ma.masked_invalid(array),
            cmap=matplotlib.colormaps["RdBu_r" if diverging else "viridis"].with_extremes(
                bad=out_of_reach
            ),
            vmin=None if limit is None else -limit,
            vmax=limit,
            shading="nearest",
            rasterized=True,  # else many viewers show seams between the cells
        )
        _plane.color_bar_above(axes, mesh, f"{label} [{unit or '–'}]")
        axes.set_xlabel(f"x [{length}]")
        axes.set_ylabel(f"y [{length}]")
    return figure_of(axes)


def points(
    points: Any,
    *,
    ellipses: Any = None,
    targets: Any = None,
    labels: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw points in space, such as the ends of reaches, with ellipses around them.

    Arguments:
        points: positions [m], (n, 2); or a list of such, one entry for each colour.
        ellipses: what `analysis.endpoint_ellipse` returns, or a tuple (centre (2,) [m], half axes
            (2,) [m], angle of the first from +x [rad]); or a list of such, one for each entry of
            `points`, drawn in its colour.
        targets: positions [m], (2,) or (n, 2), drawn as rings.
        labels: one name for each entry of the list `points`.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels or ellipses, or no finite point.
    """
    groups = _samples.groups("points", points, _POINTS, (2,))
    for group in groups:
        if len(group) > 1:
            raise _samples.wrong_shape("points", group.shape, _POINTS)
    names = _samples.names_for("labels", labels, len(groups), "entry of `points`")
    rings = _samples.points("targets", targets)
    rims = _ellipses(ellipses, len(groups))
    boxes = [
        centre + sign * _reach(half, angle) for centre, half, angle in rims for sign in (-1, 1)
    ]
    everything = np.concatenate([*(group[0] for group in groups), rings, *np.array(boxes)[:, None]])
    with drawing(ax, _plane.size_for(everything, len(groups) + 1)) as axes:
        unit, scale = _plane.length_unit(axes, everything)
        axes.margins(0.04)
        axes.set_aspect("equal", anchor="NW")
        for i, group in enumerate(groups):
            name = names[i] if names else None if len(groups) == 1 else f"{i + 1}"
            rim = rims[i] if rims else None
            _draw_points(axes, scale, group[0], rim, name)
        _marks.mark(axes, scale * rings, "target", _RING)
        axes.set_xlabel(f"x [{unit}]")
        axes.set_ylabel(f"y [{unit}]")
        _marks.not_too_narrow(axes)
        _marks.legend(axes)
    return figure_of(axes)


def _grid(name: str, value: Any) -> np.ndarray:
    """Return the positions of rows or columns (n,), which increase."""
    line = _samples.shaped(name, value, (None,), "(n,)")
    if len(line) < 2 or not (np.diff(line) > 0).all():
        raise ValueError(f"{name}: at least two positions are wanted, finite and increasing")
    return line


def _ellipses(value: Any, count: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return the centre (2,), half axes (2,) and angle of each ellipse; none for None."""
    if value is None:
        return []
    if isinstance(value, tuple) or hasattr(value, "half_axes"):
        value = [value]
    entries = [
        (entry.centre, entry.half_axes, entry.angle) if hasattr(entry, "half_axes") else entry
        for entry in value
    ]
    if len(entries) != count:
        raise ValueError(
            f"ellipses: {len(entries)} given, wanted {count}, one for each entry of `points`"
        )
    found = []
    for i, entry in enumerate(entries):
        name = f"ellipses[{i}]"
        try:
            centre, half, angle = entry
        except (TypeError, ValueError):
            raise ValueError(f"{name}: a tuple (centre, half_axes, angle) is wanted") from None
        centre = _samples.shaped(f"{name}, centre", centre, (2,), "(2,)")
        half = _samples.shaped(f"{name}, half_axes", half, (2,), "(2,)")
        angle = float(_samples.shaped(f"{name}, angle", angle, (), "()"))
        if not np.isfinite([*centre, *half]).all() or (half < 0).any():
            raise ValueError(f"{name}: finite numbers and half axes from 0 are wanted, got {entry}")
        found.append((centre, half, angle))
    return found


def _reach(half: np.ndarray, angle: float) -> np.ndarray:
    """Return how far an ellipse reaches from its centre along x and y, (2,)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.hypot(half[0] * np.array([cosine, sine]), half[1] * np.array([sine, cosine]))


def _draw_points(
    ax: Axes,
    scale: float,
    points: np.ndarray,
    ellipse: tuple[np.ndarray, np.ndarray, float] | None,
    name: str | None,
) -> None:
    """Draw points (n, 2) [m], `scale` units each, in one colour, with their ellipse."""
    color, dash = _marks.next_look(ax)
    _marks.draw_points(ax, scale * points.T, color, name)
    if ellipse is not None:
        centre, half, angle = ellipse
        width, height = 2 * scale * half
        degrees = float(np.degrees(angle))
        rim = Ellipse(tuple(scale * centre), width, height, angle=degrees, fill=False, zorder=3)
        rim.set(edgecolor=color, linestyle=dash, linewidth=1.2)
        ax.add_patch(rim)
