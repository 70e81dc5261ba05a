"""Figure 4.3 of Li (2006): the cost of the muscle arm against computing time, for each method.

A: from one start, the nominal control; B: from 8 random controls, smooth in time, U[0, 0.3] at
each. The thesis's caption says iterations and its axes CPU time; drawn is the time. It does not
state its 8 initial conditions: here they are initial controls. Times are warm medians of
processor time on one core, each from the start to an iterate, of solves that follow one another
inside one compiled call. The thesis's DDP is the textbook's; ours, which takes ILQR's steps until
it is near, is drawn beside it.
"""

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import jaxctrl as jc

from ._chapter_4 import Case, arm_case, random_controls, timed
from ._result import Claim, Result, named

METHODS = {
    "ILQR": jc.ILQR,
    "DDP": jc.DDP,
    "textbook DDP": partial(jc.DDP, start="exact"),
    "CG": jc.ConjugateGradient,
}
NOTES = {
    "DDP": "DDP begins with ILQR's own steps here, and never forms the tensors of second "
    "derivatives.",
    "textbook DDP": "It never forms the tensors of second derivatives, either.",
}
AMPLITUDE = 0.3
SOON = 2.0
"""Curves are compared where ILQR is within this factor of the best cost."""


@dataclass(frozen=True)
class Config:
    """Settings: time steps, number of random starts, iterations, points of each curve at most,
    repetitions of each timing, and seed."""

    num_steps: int = 100
    starts: int = 8
    max_steps: int = 500
    points: int = 16
    repeats: int = 5
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with few starts, a coarse time step and little patience."""
        return cls(num_steps=20, starts=2, max_steps=60, points=6, repeats=2)


def run(config: Config) -> Result:
    """Trace cost and time of every method; arrays lead with method, start (0 nominal), point."""
    case = arm_case("muscle", config.num_steps)
    random = random_controls(case, config.starts, AMPLITUDE, config.seed)
    uss = jnp.asarray(np.concatenate([np.asarray(case.problem.nominal_controls)[None], random]))
    curves = np.stack([_curves(case, method, uss, config) for method in METHODS.values()])
    missing = {"missing": "NaN after the last point of a curve"}
    dims = ("solver", "start", "point")
    data = xarray.Dataset(
        {
            "seconds": (
                dims,
                curves[..., 0],
                named("warm processor time from the start", "s") | missing,
            ),
            "cost": (dims, curves[..., 1], named("cost of the iterate", "1") | missing),
            "iterate": (dims, curves[..., 2], named("number of the iterate", "1") | missing),
        },
        coords={
            "solver": ("solver", list(METHODS), {"long_name": "solver"}),
            "start": ("start", np.arange(len(uss)), named("start, 0 the nominal control", "1")),
        },
    )
    return Result(data, config)


def _curves(case: Case, method, uss, config: Config) -> np.ndarray:
    """Return time, cost and number of some iterates from each start, (start, point, 3)."""
    curves, to = np.full((len(uss), config.points, 3), np.nan), timed(case, method())
    for lane, us in enumerate(uss):
        count = int(to(us, config.max_steps, 1)[1])
        spaced = np.geomspace(1, max(count, 1), config.points - 1).round()
        iterates = np.unique(np.concatenate([[0.0], spaced]))
        calls = [partial(to, us, int(i)) for i in iterates]
        taken = np.median(jc.stopwatch.in_turns(calls, config.repeats).cpu, axis=0)
        # Each iterate is timed by itself; none is reached before an earlier one.
        taken = np.maximum.accumulate(taken)
        cost = [float(to(us, int(i), 1)[0]) for i in iterates]
        curves[lane, : iterates.size] = np.stack([taken, cost, iterates], axis=1)
    return curves


def figure(result: Result) -> Figure:
    """Draw cost against time, from the nominal control and from the random ones."""
    data = result.data
    fig, axes = jc.plot.panels(1, 2, size=(7.2, 3.0))
    titles = ("A  nominal start", f"B  {data.sizes['start'] - 1} random starts")
    for ax, lanes, title in zip(axes[0], (slice(1), slice(1, None)), titles, strict=True):
        with jc.plot.style():
            _draw(ax, data.isel(start=lanes))
            ax.set_title(title, loc="left")
            ax.set_xlabel("time [ms]")
    with jc.plot.style():
        axes[0, 0].set_ylabel("cost [1]")
        axes[0, 0].legend()
        _explain_fan(axes[0, 1])
    return fig


def _draw(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the cost of one start; of several, the median reached by each time, and the range."""
    for i, method in enumerate(data.solver.values):
        one = data.sel(solver=method)
        look = {"color": f"C{i}", "linestyle": ("-", "--", ":", "-.")[i]}
        if one.sizes["start"] == 1:
            ax.loglog(1e3 * one.seconds.values[0], one.cost.values[0], label=method, **look)
            continue
        times = np.geomspace(
            np.nanmin(one.seconds.where(one.seconds > 0)), np.nanmax(one.seconds), 100
        )
        lanes = [one.isel(start=lane) for lane in range(one.sizes["start"])]
        reached = np.array([[_at(lane, time) for time in times] for lane in lanes])
        ax.loglog(1e3 * times, np.median(reached, axis=0), **look)
        ax.fill_between(
            1e3 * times, reached.min(axis=0), reached.max(axis=0), color=f"C{i}", alpha=0.2,
            linewidth=0,
        )  # fmt: skip


def _explain_fan(ax: Axes) -> None:
    """Name what a line and its band are, whatever the method."""
    grey = "0.4"
    handles = [Line2D([], [], color=grey), Patch(color=grey, alpha=0.3, linewidth=0)]
    ax.legend(handles, ["median by then", "lowest to highest"])


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.3."""
    data = result.data
    best = float(np.nanmin(data.cost.values))
    groups = (("the nominal start", slice(1)), ("random starts", slice(1, None)))
    return [
        _below(data.isel(start=lanes), rival, where, best)
        for where, lanes in groups
        for rival in METHODS
        if rival != "ILQR"
    ]


def _below(lanes: xarray.Dataset, rival: str, where: str, best: float) -> Claim:
    """Compare ILQR with a rival at the time when ILQR is soon done."""
    count, below, ratios = lanes.sizes["start"], 0, []
    for lane in range(count):
        mine, other = (lanes.sel(solver=m).isel(start=lane) for m in ("ILQR", rival))
        there = _when(mine, best)
        below += bool(np.isfinite(there) and _at(mine, there) <= _at(other, there))
        ratios.append(_when(other, best) / there)
    known = [ratio for ratio in ratios if np.isfinite(ratio)]
    times = f", and {rival} {np.median(known):.2g} times as late (median)" if known else ""
    return Claim(
        f"At equal time ILQR's cost is below {rival}'s, from {where}",
        "Li (2006), fig. 4.3",
        "below",
        f"from {below} of {count}, at the time when ILQR is within a factor {SOON:g} of the best "
        f"cost{times}; {rival} comes there from {len(known)} of {count}",
        below == count,
        NOTES.get(rival, ""),
    )


def _when(one: xarray.Dataset, best: float) -> float:
    """Return when a curve comes within the factor of the best cost, infinite if never."""
    reached = one.cost.values <= SOON * best
    return float(one.seconds.values[np.argmax(reached)]) if reached.any() else np.inf


def _at(one: xarray.Dataset, seconds: float) -> float:
    """Return the lowest cost that a curve has reached by a time."""
    return float(np.min(np.where(one.seconds.values <= seconds, one.cost.values, np.inf)))
