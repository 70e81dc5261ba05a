"""What the plots share: curves with their mean, marks for starts and targets, the legend."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

TARGET = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 1.3}
START = {"marker": "o", "markersize": 4.5, "markeredgewidth": 0.0}
VIA = {"marker": "x", "markersize": 6, "markeredgewidth": 1.3}
END = {"marker": "s", "markersize": 4.5, "markeredgewidth": 0.0}

_MANY = 5000  # points beyond which a vector file would take long to show


def next_look(ax: Axes) -> tuple[str, str]:
    """Take the next colour and dash of the Axes' own cycle."""
    (line,) = ax.plot([], [])
    look = to_hex(line.get_color()), str(line.get_linestyle())
    line.remove()
    return look


def draw_group(ax: Axes, xs: np.ndarray, ys: np.ndarray, label: str | None) -> str:
    """Draw curves xs, ys (trials, N), thin and transparent, with their mean on top.

    A single trial is one plain line. Returns the colour.
    """
    color, dash = next_look(ax)
    trials = len(xs)
    if trials == 1:
        ax.plot(xs[0], ys[0], color=color, linestyle=dash, label=label)
        return color
    segments = np.stack([xs, ys], axis=-1)
    bundle = LineCollection(
        list(segments),
        colors=[tint(ax, color)],
        linewidths=0.9 if trials <= 30 else 0.6,
        alpha=transparency(trials),
        label=f"{trials} trials" if label is None else None,
    )
    bundle.set_capstyle("butt")
    ax.add_collection(bundle, autolim=False)
    ax.update_datalim(segments.reshape(-1, 2)[np.isfinite(segments).all(axis=-1).ravel()])
    (mean,) = ax.plot(mean_of(xs), mean_of(ys), color=color, linestyle=dash, zorder=3)
    mean.set_label("mean" if label is None else label)
    ax.autoscale_view()
    return color


def draw_over_time(
    ax: Axes, clocks: list[np.ndarray], groups: list[np.ndarray], names: list[str] | None
) -> None:
    """Draw groups (trials, N) over their times (N,), upwards from zero if none is negative."""
    for i, (clock, group) in enumerate(zip(clocks, groups, strict=True)):
        name = names[i] if names else None if len(groups) == 1 else f"{i + 1}"
        draw_group(ax, np.broadcast_to(clock, group.shape), group, name)
    if min(np.nanmin(group) for group in groups if not np.isnan(group).all()) >= 0:
        ax.set_ylim(bottom=0)


def draw_points(ax: Axes, points: np.ndarray, color: str, label: str | None) -> None:
    """Draw points (2, n), small and transparent, so that many do not hide each other."""
    count = points.shape[1]
    look: dict[str, Any] = {"linestyle": "none", "marker": "o", "markeredgewidth": 0.0}
    look["color"] = tint(ax, color)
    alpha = float(np.clip(300 / count, 0.1, 0.7))
    size = 2.5 if count <= 1000 else 2.0
    ax.plot(*points, markersize=size, alpha=alpha, rasterized=count > _MANY, **look)
    ax.plot([], [], markersize=4, label=label, **look)


def draw_discs(ax: Axes, discs: np.ndarray, label: str) -> None:
    """Draw discs (x, y, radius), (n, 3), grey and with an edge, beneath every curve."""
    edge = matplotlib.rcParams["grid.color"]
    face = tint(ax, to_hex(tint(ax, edge)))
    for x, y, radius in discs:
        ax.add_patch(Circle((x, y), radius, facecolor=face, edgecolor=edge, linewidth=0.9))
    if len(discs):
        look = {"markerfacecolor": face, "markeredgecolor": edge, "markeredgewidth": 0.9}
        ax.plot([], [], linestyle="none", marker="o", markersize=6.5, label=label, **look)


def tint(ax: Axes, color: str) -> tuple[float, float, float]:
    """Return a colour halfway to the background: however many curves overlap, it stays light."""
    red, green, blue = 0.5 * np.array(to_rgb(color)) + 0.5 * np.array(to_rgb(ax.get_facecolor()))
    return float(red), float(green), float(blue)


def transparency(count: int) -> float:
    """Return the opacity at which single ones of `count` curves are seen, and where they crowd."""
    return float(np.clip(60 / count, 0.3, 0.9))


def mark(ax: Axes, points: np.ndarray, label: str, look: dict) -> None:
    """Mark points (n, 2), each place once, in the colour of the text; above every curve.

    The limits of the data grow by the marks, so that none is cut by the Axes.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    extent = np.ptp(np.vstack([points, ax.dataLim.get_points()]), axis=0)
    if ax.get_aspect() == 1.0:
        extent = np.full(2, extent.max())
    pad = 0.06 * np.where(np.isfinite(extent), extent, 0.0)
    ax.update_datalim(np.vstack([points - pad, points + pad]))
    resolution = np.where(pad > 0, pad / 60, 1.0)
    _, first = np.unique(np.round(points / resolution), axis=0, return_index=True)
    points = points[np.sort(first)]
    color = matplotlib.rcParams["text.color"]
    ax.plot(*points.T, linestyle="none", color=color, label=label, zorder=4, **look)


def first_points(groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return the first finite point of each path (N, 2), as (n, 2)."""
    return _pick(groups, 0)


def last_points(groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return the last finite point of each path (N, 2), as (n, 2)."""
    return _pick(groups, -1)


def _pick(paths: Sequence[np.ndarray], index: int) -> np.ndarray:
    """Return one of the finite points of each path; paths without any are left out."""
    finite = [path[np.isfinite(path).all(axis=1)] for path in paths]
    return np.array([path[index] for path in finite if len(path)]).reshape(-1, 2)


def is_dark(ax: Axes) -> bool:
    """Say whether the Axes' background is dark."""
    return float(np.dot(to_rgb(ax.get_facecolor()), (0.2126, 0.7152, 0.0722))) < 0.5


def sequence_of_colors(ax: Axes) -> Colormap:
    """Return viridis without the end that fades into the background; the last stands out most."""
    span = np.linspace(0.2, 1.0, 256) if is_dark(ax) else np.linspace(0.9, 0.0, 256)
    return ListedColormap(matplotlib.colormaps["viridis"](span), name="jaxctrl_sequence")


def not_too_narrow(ax: Axes) -> None:
    """Widen the limits of an Axes of equal aspect until no side is less than half the other."""
    low, high = ax.dataLim.get_points()
    extent = high - low
    grow = np.maximum(0.5 * extent.max() - extent, 0.0) / 2 if extent.max() > 0 else 0.5
    ax.update_datalim([low - grow, high + grow])
    ax.autoscale_view()


def legend(ax: Axes) -> None:
    """Put the legend right of the Axes; each name once, in columns of at most twelve."""
    named = {}
    for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
        named.setdefault(label, handle)
    if not named:
        return
    made = ax.legend(
        list(named.values()),
        list(named),
        loc="upper left",
        bbox_to_anchor=(1.03, 1.0),
        ncols=math.ceil(len(named) / 12),
    )
    for handle in made.legend_handles:
        if isinstance(handle, Line2D):
            handle.set_alpha(1.0)
            handle.set_linewidth(max(handle.get_linewidth(), 0.9))
            handle.set_markersize(min(handle.get_markersize(), 6.5))


def mean_of(group: np.ndarray) -> np.ndarray:
    """Return the mean over the trials of a group, sample by sample, over the finite ones."""
    finite = np.isfinite(group)
    count = finite.sum(axis=0)
    total = np.where(finite, group, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
