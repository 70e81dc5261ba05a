"""Axes that show a plane: the unit of length, the size for equal aspect, a colour bar above."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable

from ._style import COLUMN, figure_of


def length_unit(ax: Axes, points: np.ndarray) -> tuple[str, float]:
    """Return the unit of an Axes and units per metre: its own if it has one, else by extent."""
    for unit, scale in (("cm", 100.0), ("m", 1.0)):
        if ax.get_xlabel() == f"x [{unit}]":
            return unit, scale
    return ("cm", 100.0) if _extent(points).max() < 0.5 else ("m", 1.0)


def size_for(points: np.ndarray, rows: int, color_bar: bool = False) -> tuple[float, float]:
    """Return the figure size [inch] for points of equal aspect and a legend of so many rows."""
    width, height = _extent(points)
    across = COLUMN - 1.35  # less the labels on the left and the legend on the right
    ratio = height / width if width > 0 else np.inf
    down = min(across * float(np.clip(ratio, 0.5, 2)), 2.9) + (0.9 if color_bar else 0.45)
    return COLUMN, max(down, 0.3 + 0.15 * min(rows, 12))


def color_bar_above(ax: Axes, colors: ScalarMappable, label: str, ticks: Any = None) -> None:
    """Draw a colour bar as wide as the Axes above it, so that its right is left for the legend."""
    above = ax.inset_axes((0.0, 1.05, 1.0, 0.04))
    bar = figure_of(ax).colorbar(colors, cax=above, label=label, location="top", ticks=ticks)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _extent(points: np.ndarray) -> np.ndarray:
    """Return the width and height of the finite points (n, 2)."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.ptp(finite, axis=0) if len(finite) else np.zeros(2)
