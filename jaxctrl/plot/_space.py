"""Paths in a plane: of the hand in space, of two joints, of a pendulum's state."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

from .. import _samples
from . import _marks, _plane
from ._style import COLUMN, drawing, figure_of

_PATHS = "(N, 2), (trials, N, 2) or a list of these"
_PLANE = "(N, 2), (n, N, 2) or a list of (N, 2)"
_MANY = 8  # beyond so many unlabelled paths they are a sequence, not things with names


def hand_paths(
    paths: Any,
    targets: Any = None,
    *,
    starts: Any = None,
    via: Any = None,
    obstacles: Any = None,
    labels: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw paths of the hand in space, with starts and targets, at equal aspect.

    The axes are in centimetres when everything fits into half a metre, else in metres. Trials
    are thin and transparent under their mean path. Samples that are not finite leave gaps.

    Arguments:
        paths: positions [m], (N, 2); or (trials, N, 2), drawn in one colour with their mean; or a
            list of either, one entry for each colour (direction, condition).
        targets: positions [m], (2,) or (n, 2), drawn as rings.
        starts: positions [m], (2,) or (n, 2), drawn as dots; by default where each mean path
            begins. An empty list draws none.
        via: positions of via-points [m], (2,) or (n, 2), drawn as crosses.
        obstacles: discs (x, y, radius) [m], (3,) or (n, 3), drawn to scale.
        labels: one name for each entry of the list `paths`.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, no finite sample, or a radius
        that is not positive.
    """
    groups = _samples.groups("paths", paths, _PATHS, (2,))
    names = _samples.names_for("labels", labels, len(groups), "entry of `paths`")
    marks, crosses = _samples.points("targets", targets), _samples.points("via", via)
    discs = _discs(obstacles)
    means = [_marks.mean_of(group) for group in groups]
    begins = _marks.first_points(means) if starts is None else _samples.points("starts", starts)
    corners = [discs[:, :2] + sign * discs[:, 2:] for sign in (-1, 1)]
    everything = np.concatenate(
        [*(group.reshape(-1, 2) for group in groups), marks, begins, crosses, *corners]
    )
    rows = len(groups) + 2 + (len(crosses) > 0) + (len(discs) > 0)
    with drawing(ax, _plane.size_for(everything, rows)) as axes:
        unit, scale = _plane.length_unit(axes, everything)
        axes.margins(0.02)
        axes.set_aspect("equal", anchor="NW")
        for i, group in enumerate(groups):
            name = names[i] if names else None if len(groups) == 1 else f"{i + 1}"
            _marks.draw_group(axes, scale * group[..., 0], scale * group[..., 1], name)
        _marks.draw_discs(axes, scale * discs, "obstacle")
        _marks.mark(axes, scale * begins, "start", _marks.START)
        _marks.mark(axes, scale * crosses, "via-point", _marks.VIA)
        _marks.mark(axes, scale * marks, "target", _marks.TARGET)
        axes.set_xlabel(f"x [{unit}]")
        axes.set_ylabel(f"y [{unit}]")
        _marks.not_too_narrow(axes)
        _marks.legend(axes)
    return figure_of(axes)


def joint_paths(
    qs: Any,
    *,
    target: Any = None,
    labels: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw paths of two joints, elbow angle against shoulder angle, at equal aspect.

    More than eight paths without labels are taken for the iterations of a solver: coloured from
    the first to the last, with a colour bar.

    Arguments:
        qs: joint angles (shoulder, elbow) [rad], (N, 2) or (n, N, 2), or a list of (N, 2).
        target: joint angles [rad], (2,) or (n, 2), drawn as rings.
        labels: one name for each path.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, or no finite sample.
    """
    paths = _plane_paths("qs", qs)
    names = _samples.names_for("labels", labels, len(paths), "path")
    marks = _samples.points("target", target)
    sequence = _is_sequence(paths, names)
    rows = 3 if sequence else len(paths) + 3
    with drawing(ax, _plane.size_for(np.concatenate([*paths, marks]), rows, sequence)) as axes:
        axes.set_aspect("equal", anchor="NW")
        _draw_paths(axes, paths, names, "iteration", 0)
        _marks.mark(axes, marks, "target", _marks.TARGET)
        axes.set_xlabel("shoulder [rad]")
        axes.set_ylabel("elbow [rad]")
        _marks.not_too_narrow(axes)
        _marks.legend(axes)
    return figure_of(axes)


def phase(
    xs: Any,
    *,
    labels: str | Sequence[str] | None = None,
    target: Any = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw paths of a pendulum in its phase plane, angular velocity against angle.

    More than eight paths without labels are coloured from the first to the last.

    Arguments:
        xs: angle [rad] and angular velocity [rad/s], (N, 2) or (n, N, 2), or a list of (N, 2).
        labels: one name for each path.
        target: angle [rad] and angular velocity [rad/s], (2,) or (n, 2), drawn as rings.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, or no finite sample.
    """
    paths = _plane_paths("xs", xs)
    names = _samples.names_for("labels", labels, len(paths), "path")
    marks = _samples.points("target", target)
    angles = np.concatenate([*paths, marks])[:, 0]
    with drawing(ax, (COLUMN, 2.8 if _is_sequence(paths, names) else 2.4)) as axes:
        _draw_paths(axes, paths, names, "path", 1)
        _marks.mark(axes, marks, "target", _marks.TARGET)
        if np.nanmax(angles) - np.nanmin(angles) >= 0.75 * np.pi:
            _ticks_of_pi(axes, float(np.nanmax(angles) - np.nanmin(angles)))
        axes.set_xlabel("angle [rad]")
        axes.set_ylabel("angular velocity [rad/s]")
        _marks.legend(axes)
    return figure_of(axes)


def _discs(value: Any) -> np.ndarray:
    """Return one disc (3,) or several (n, 3) as (n, 3); none for None or an empty list."""
    discs = _samples.points("obstacles", value, 3)
    if not (np.isfinite(discs).all() and (discs[:, 2] > 0).all()):
        raise ValueError(f"obstacles: finite (x, y) and a positive radius are wanted, got {value}")
    return discs


def _plane_paths(name: str, value: Any) -> list[np.ndarray]:
    """Return the paths of an array or list as arrays (N, 2)."""
    return [path for group in _samples.groups(name, value, _PLANE, (2,)) for path in group]


def _draw_paths(
    ax: Axes, paths: list[np.ndarray], names: list[str] | None, thing: str, first: int
) -> None:
    """Draw paths (N, 2) with their first and last points.

    Many are coloured in sequence, with a colour bar that counts the `thing` from `first`.
    """
    ax.margins(0.02)
    sequence = _is_sequence(paths, names)
    if sequence:
        colors = _marks.sequence_of_colors(ax)
        scale = Normalize(first, first + len(paths) - 1)
        width = 0.8 * matplotlib.rcParams["lines.linewidth"]
        for i, path in enumerate(paths):
            ax.plot(*path.T, color=colors(scale(first + i)), linestyle="-", linewidth=width)
        whole = MaxNLocator(integer=True, steps=[1, 2, 5, 10])
        _plane.color_bar_above(ax, ScalarMappable(scale, colors), thing, whole)
        ends = paths[-1:]
    else:
        for i, path in enumerate(paths):
            name = names[i] if names else f"{i + 1}" if len(paths) > 1 else None
            ax.plot(*path.T, label=name)
        ends = paths
    start = _marks.START | ({"markersize": 3.5} if sequence else {})
    _marks.mark(ax, _marks.first_points(paths), "start", start)
    _marks.mark(ax, _marks.last_points(ends), "end", _marks.END)


def _is_sequence(paths: list[np.ndarray], names: list[str] | None) -> bool:
    """Say whether paths are a sequence, to be coloured in order, rather than things with names."""
    return names is None and len(paths) > _MANY


def _ticks_of_pi(ax: Axes, span: float) -> None:
    """Put the ticks of an angle at simple multiples of pi, no more than about seven of them."""
    steps = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    step = next((s for s in steps if span / (s * np.pi) <= 5), None)
    if step is None:
        return
    names = {0.25: "π/4", 0.5: "π/2", 0.75: "3π/4", 1.0: "π", 0.0: "0"}

    def name(value: float, _position: int | None = None) -> str:
        multiple = round(value / np.pi / 0.25) * 0.25
        sign = "−" if multiple < 0 else ""
        size = abs(multiple)
        if size in names:
            return sign + names[size]
        if size == int(size):
            return f"{sign}{int(size)}π"
        over = 2 if 2 * size == int(2 * size) else 4
        return f"{sign}{int(over * size)}π/{over}"

    ax.xaxis.set_major_locator(MultipleLocator(step * np.pi))
    ax.xaxis.set_major_formatter(FuncFormatter(name))
