"""How a solver came to its result: cost, gradient, step and regularisation by iteration."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .. import _samples
from . import _marks
from ._style import COLUMN, drawing, panels

_MANY = 8  # beyond so many unlabelled lanes only the best stands out


def convergence(
    cost: Any,
    *,
    gradient: Any = None,
    step: Any = None,
    lam: Any = None,
    labels: str | Sequence[str] | None = None,
) -> Figure:
    """Draw the history of a solver, one panel for each trace, over the iterations from 0.

    Histories are padded: a lane ends where its NaNs begin. The scale is logarithmic where no
    value is negative and they span a decade or more; exact zeros then lie at a 0 below the
    smallest decade. Of more than eight lanes without labels, the one with the lowest last cost is
    drawn on top of the others.

    Arguments:
        cost: cost [arbitrary units], (n,) or (lanes, n).
        gradient: norm of the gradient [arbitrary units], of the shape of `cost`.
        step: accepted length of the line search, dimensionless, of the shape of `cost`.
        lam: relative regularisation lambda, dimensionless, of the shape of `cost`.
        labels: one name for each lane.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, or no finite sample.
    """
    costs = _lanes("cost", cost, None)
    traces = [("cost [a.u.]", costs)]
    for name, label, value in (
        ("gradient", "gradient [a.u.]", gradient),
        ("step", "step [–]", step),
        ("lam", "λ [–]", lam),
    ):
        if value is not None:
            traces.append((label, _lanes(name, value, np.shape(cost))))
    names = _samples.names_for("labels", labels, len(costs), "lane")
    size = (COLUMN, 2.1 if len(traces) == 1 else 0.4 + 1.25 * len(traces))
    figure, axes = panels(len(traces), sharex=True, size=size)
    best = None
    if names is None and len(costs) > _MANY:
        best = int(np.nanargmin([_last(lane)[1] for lane in costs]))
    for ax, (label, lanes) in zip(axes[:, 0], traces, strict=True):
        with drawing(ax, size):
            _draw_lanes(ax, lanes, names, best)
            _set_scale(ax, lanes)
            ax.set_ylabel(label)
            ax.label_outer()
    with drawing(axes[-1, 0], size):
        axes[-1, 0].set_xlabel("iteration")
        axes[-1, 0].xaxis.set_major_locator(
            MaxNLocator(integer=True, min_n_ticks=1, steps=[1, 2, 5, 10])
        )
        _marks.legend(axes[0, 0])
        figure.align_ylabels(axes[:, 0])
    return figure


def _lanes(name: str, value: Any, shape: tuple[int | None, ...] | None) -> np.ndarray:
    """Return a history as (lanes, n); a flat one is a single lane."""
    wanted = "(n,) or (lanes, n)" if shape is None else f"{shape}, as `cost`"
    array = _samples.samples(name, value, wanted)
    if array.ndim == 1 and shape is None:
        shape = (None,)
    return np.atleast_2d(_samples.shaped(name, array, shape or (None, None), wanted))


def _last(lane: np.ndarray) -> tuple[int, float]:
    """Return the last iteration of a lane (n,) and its value; NaN if it has none."""
    finite = np.flatnonzero(np.isfinite(lane))
    return (int(finite[-1]), float(lane[finite[-1]])) if len(finite) else (0, np.nan)


def _set_scale(ax: Axes, lanes: np.ndarray) -> None:
    """Make the vertical axis logarithmic if no value is negative and they span a decade."""
    positive = lanes[lanes > 0]
    if np.nanmin(lanes) < 0 or not positive.size or positive.max() < 10 * positive.min():
        return
    if np.nanmin(lanes) > 0:
        ax.set_yscale("log")
        return
    low, high = (int(np.floor(np.log10(value))) for value in (positive.min(), positive.max()))
    stride = (high - low) // 4 + 1
    ax.set_yscale("symlog", linthresh=10.0**low, linscale=float(stride))
    ax.set_yticks([0.0, *(10.0**power for power in range(low, high + 2, stride))])
    ax.set_yticks([], minor=True)
    ax.set_ylim(-0.2 * 10.0**low, 2 * positive.max())


def _draw_lanes(ax: Axes, lanes: np.ndarray, names: list[str] | None, best: int | None) -> None:
    """Draw lanes (lanes, n): each with points, or many thin ones with the best on top."""
    iterations = np.arange(lanes.shape[1])
    if best is None:
        longest = max(_last(lane)[0] for lane in lanes)
        for i, lane in enumerate(lanes):
            name = names[i] if names else f"{i + 1}" if len(lanes) > 1 else None
            ax.plot(iterations, lane, label=name, marker=".", markersize=4 if longest <= 40 else 2)
        return
    color = _marks.tint(ax, _marks.next_look(ax)[0])
    alpha = _marks.transparency(len(lanes))
    others = [i for i in range(len(lanes)) if i != best]
    for i in others:
        label = f"{len(others)} others" if i == others[0] else None
        ax.plot(
            iterations,
            lanes[i],
            color=color,
            linestyle="-",
            linewidth=0.6,
            alpha=alpha,
            label=label,
        )
    ends = np.array([_last(lane) for lane in lanes[others]])
    ax.plot(*ends.T, linestyle="none", color=color, marker=".", markersize=3)
    ax.plot(
        iterations,
        lanes[best],
        color=matplotlib.rcParams["text.color"],
        linestyle="-",
        zorder=3,
        label="lowest cost",
    )
