"""How fast the hand moves where its path is curved: over time, and as a power law."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from .. import _samples
from . import _marks
from ._style import COLUMN, drawing, figure_of, panels

_CURVES = "(N,), (trials, N) or a list of these"


def speed_and_curvature(
    ts: Any,
    speeds: Any,
    curvatures: Any,
    *,
    labels: str | Sequence[str] | None = None,
    marks: Any = None,
) -> Figure:
    """Draw the speed of the hand above the curvature of its path, over one time axis.

    Trials are thin and transparent under their mean. Samples that are not finite leave gaps: leave
    out the curvature where the hand all but rests.

    Arguments:
        ts: times [s], (N,); or a list of such, one for each entry of a list `speeds`.
        speeds: speeds [m/s], (N,); or (trials, N), drawn in one colour with their mean; or a list
            of either, one entry for each colour.
        curvatures: curvatures [1/m], of the shapes of `speeds`, drawn without their sign.
        labels: one name for each entry of the list `speeds`.
        marks: instants [s], () or (m,), such as those of passing via-points: thin vertical lines.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, or no finite sample.
    """
    above = _samples.groups("speeds", speeds, _CURVES)
    below = [np.abs(group) for group in _samples.groups("curvatures", curvatures, _CURVES)]
    _same_shapes("curvatures", below, "speeds", above)
    names = _samples.names_for("labels", labels, len(above), "entry of `speeds`")
    clocks = _samples.clocks(ts, above, "speeds")
    instants = [] if marks is None else _samples.times("marks", np.atleast_1d(marks))
    size = (COLUMN, 2.9)
    figure, axes = panels(2, sharex=True, size=size)
    for ax, groups, label in (
        (axes[0, 0], above, "hand speed [m/s]"),
        (axes[1, 0], below, "curvature [1/m]"),
    ):
        with drawing(ax, size):
            _marks.draw_over_time(ax, clocks, groups, names)
            for instant in instants:
                ax.axvline(instant, color=matplotlib.rcParams["grid.color"], lw=0.8, zorder=1)
            ax.set_ylabel(label)
            ax.label_outer()
    with drawing(axes[1, 0], size):
        axes[1, 0].set_xlabel("time [s]")
        _marks.legend(axes[0, 0])
        figure.align_ylabels(axes[:, 0])
    return figure


def power_law(
    radius: Any,
    speed: Any,
    *,
    exponent: Any = None,
    gain: Any = None,
    longest: float = 1.0,
    labels: str | Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the speed of the hand against its radius of curvature, with the law v = gain r^exponent.

    Both scales are logarithmic: the law is a straight line, of slope `exponent`. Points are small
    and transparent. Samples that are not finite or not positive are left out.

    Arguments:
        radius: radii of curvature r [m], (N,) or (trials, N); or a list of either, one entry for
            each colour.
        speed: speeds v [m/s], of the shapes of `radius`.
        exponent: dimensionless, a number or one for each entry; NaN draws no line.
        gain: [m^(1 - exponent)/s], a number or one for each entry.
        longest: largest radius that is drawn [m]; 1 is where `analysis.power_law` takes a path for
            straight.
        labels: one name for each entry of the list `radius`.
        ax: Axes to draw into instead of a new figure.
    Returns: the Figure.
    Raises: ValueError for a wrong shape, a wrong number of labels, an exponent without gain or the
        reverse, or an entry without any positive sample.
    """
    clouds = _clouds(_samples.groups("radius", radius, _CURVES), speed, longest)
    names = _samples.names_for("labels", labels, len(clouds), "entry of `radius`")
    if (exponent is None) != (gain is None):
        raise ValueError("exponent, gain: both or neither are wanted")
    laws = [
        _samples.one_for_each(name, np.nan if value is None else value, len(clouds))
        for name, value in (("exponent", exponent), ("gain", gain))
    ]
    with drawing(ax, (COLUMN, 2.3)) as axes:
        axes.set_xscale("log")
        axes.set_yscale("log")
        for i, (cloud, law) in enumerate(zip(clouds, np.transpose(laws), strict=True)):
            name = names[i] if names else None if len(clouds) == 1 else f"{i + 1}"
            _draw_cloud(axes, cloud, name, *law)
        axes.autoscale_view()
        _readable_ticks(axes.xaxis, *axes.get_xlim())
        _readable_ticks(axes.yaxis, *axes.get_ylim())
        axes.set_xlabel("radius of curvature [m]")
        axes.set_ylabel("hand speed [m/s]")
        _marks.legend(axes)
    return figure_of(axes)


def _clouds(radii: list[np.ndarray], speed: Any, longest: float) -> list[np.ndarray]:
    """Return the positive samples of each entry up to a radius, radius and speed, as (2, n)."""
    speeds = _samples.groups("speed", speed, _CURVES)
    _same_shapes("speed", speeds, "radius", radii)
    clouds = []
    for i, pair in enumerate(zip(radii, speeds, strict=True)):
        cloud = np.stack([array.ravel() for array in pair])
        clouds.append(cloud[:, (cloud > 0).all(axis=0) & (cloud[0] <= longest)])
        if not clouds[-1].size:
            raise ValueError(
                f"radius, speed: entry {i} has no sample where both are positive and the radius is "
                f"at most {longest:g} m"
            )
    return clouds


def _same_shapes(name: str, given: list[np.ndarray], like: str, wanted: list[np.ndarray]) -> None:
    """Raise ValueError unless two lists of groups (trials, N) have the same shapes."""
    got, want = [[group.shape for group in groups] for groups in (given, wanted)]
    if got != want:
        raise ValueError(f"{name}: (trials, N) of each entry is {got}, wanted {want}, as `{like}`")


def _draw_cloud(
    ax: Axes, cloud: np.ndarray, name: str | None, exponent: float, gain: float
) -> None:
    """Draw samples (2, n) as points, and the law over the range of their radii."""
    color, dash = _marks.next_look(ax)
    _marks.draw_points(ax, cloud, color, name or "samples")
    if np.isfinite(exponent) and np.isfinite(gain):
        ends = np.array([cloud[0].min(), cloud[0].max()])
        label = f"$v = {gain:.2g}\\,r^{{\\,{exponent:.2f}}}$"
        ax.plot(ends, gain * ends**exponent, color=color, linestyle=dash, zorder=3, label=label)


def _readable_ticks(axis: Axis, low: float, high: float) -> None:
    """Label round numbers within a decade, and 1, 2 and 5 of each where there are few decades."""
    if high < 8 * low:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    elif high < 60 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    if low > 5e-4:
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
