"""Table 4.1 of Li (2006): time and iterations of ILQR and its rivals.

One rule for all: the time from the start until the iterate's cost is within a tolerance of the best
cost known, which is the lowest of all methods and of ILQR, continued by DDP, from random controls.
All start from the plant's nominal control (no torque; excitations of 0.05) under the same bounds;
the thesis states neither its start nor its stopping rule: hence three tolerances, 10 %, 1 % and
1e-4. Cost (4.20) is taken with the stopping term, that the thesis's text asks for, and as printed,
without it. The pendulum has 0.5 s, since the thesis's rates reach -15 rad/s, and beside it 4 s, in
which it swings back first. Times are warm, by the processor's clock on one core, of all methods in
turns, and of solves that follow one another inside one compiled call: the call itself takes longer
than the torque arm's solve.

The methods are the package's own: ILQR; DDP, which begins with Gauss-Newton steps; DDP as in the
textbook, of exact second order from the first iteration, damped, which is what the thesis's DDP is
compared with; nonlinear conjugate gradients with a strong-Wolfe search (the thesis's CGD); L-BFGS,
which the thesis does not have; and collocation of Pontryagin's boundary-value problem (its ODE),
whose controls are put on the grid and judged there: it solves the problem in continuous time, so it
need not come near. With `differences` there is a textbook DDP, too, whose Hessians of the dynamics
are central differences; in any case the evaluations of the dynamics that it needs are counted.
"""

from dataclasses import dataclass

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _table_4_1_claims
from ._chapter_4 import Case, arm_case, pendulum_case
from ._differences import evaluations
from ._result import Claim, Result, named
from ._table_4_1_claims import LOWER_BOUND
from ._table_4_1_runs import NEAR, measure, methods

PROBLEMS = {
    "torque": "torque arm",
    "muscle": "muscle arm",
    "pendulum": "pendulum",
    "torque, no stop": "torque arm, (4.20) as printed",
    "muscle, no stop": "muscle arm, (4.20) as printed",
    "pendulum, 4 s": "pendulum, 4 s",
}
"""Each problem's name in full."""
_TORQUE = {"ILQR": (0.41, 6), "textbook DDP": (2.65, 15), "CG": (8.86, 17), "BVP": (11.20, np.nan)}
_MUSCLE = {
    "ILQR": (8.31, 8),
    "textbook DDP": (181.39, 15),
    "CG": (91.14, 14),
    "BVP": (LOWER_BOUND, np.nan),
}
THESIS = {
    "torque": _TORQUE,
    "muscle": _MUSCLE,
    "pendulum": {
        "ILQR": (0.26, 5),
        "textbook DDP": (1.61, 20),
        "CG": (4.95, 9),
        "BVP": (6.33, np.nan),
    },
    "torque, no stop": _TORQUE,
    "muscle, no stop": _MUSCLE,
}
"""Seconds and iterations of the table. The thesis does not say which cost its arms have."""


@dataclass(frozen=True)
class Config:
    """Settings: the problems, separated by semicolons; time steps of the movements of 0.5 s and of
    the pendulum of 4 s; limit of iterations; number of random starts in the search for the best
    cost; repetitions of each timing; whether to have DDP by differences; seed."""

    problems: str = "; ".join(PROBLEMS)
    num_steps: int = 100
    pendulum_steps: int = 400
    max_steps: int = 3000
    starts: int = 60
    repeats: int = 15
    differences: bool = False
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings for the pendulum alone, coarser, less patient and without a search."""
        return cls("pendulum", num_steps=50, max_steps=200, starts=0, repeats=2)

    def __post_init__(self):
        unknown = [name for name in self.names if name not in PROBLEMS]
        if unknown or not self.names:
            raise ValueError(
                f"problems: some of {'; '.join(PROBLEMS)} are wanted, got {self.problems!r}"
            )

    @property
    def names(self) -> list[str]:
        """The names of the problems."""
        return [name.strip() for name in self.problems.split(";")]


def run(config: Config) -> Result:
    """Let every method solve every problem; arrays lead with the problem, then the method."""
    names = config.names
    cases = [_case(name, config) for name in names]
    found = [measure(case, config) for case in cases]
    rows = [rows for rows, _, _ in found]

    def each(name: str, long_name: str, units: str = "1"):
        values = [[getattr(row, name) for row in one] for one in rows]
        return ("problem", "solver"), np.array(values), named(long_name, units)

    def reached(name: str, long_name: str, units: str):
        values = [[getattr(row, name) for row in one] for one in rows]
        missing = {"missing": "NaN where a method never comes so near, or makes no iterations"}
        return ("problem", "solver", "near"), np.array(values), named(long_name, units) | missing

    data = xarray.Dataset(
        {
            "cost": each("cost", "last cost"),
            "status": each("status", "why the solver stopped"),
            "steps": each("steps", "iterations until the solver stopped"),
            "accepted": each("accepted", "iterations that changed the controls"),
            "seconds": reached("seconds", "median warm processor time until so near", "s"),
            "spread": reached("spread", "half the interquartile range of that time", "s"),
            "wall": reached("wall", "median warm wall time until so near", "s"),
            "iterations": reached("iterations", "iterations until so near", "1"),
            "first": each(
                "first", "wall time of the first call, with compilation, to the end", "s"
            ),
            "best": ("problem", np.array([best for _, best, _ in found]), named("best cost", "1")),
            "evaluations": (
                ("problem", "order"),
                np.array([evaluations(case.problem) for case in cases]),
                named("evaluations of a step of time by differences, for slopes; Hessians", "1"),
            ),
            "undamped": (
                ("problem", "measure"),
                np.array([undamped for _, _, undamped in found]),
                named(
                    "ILQR without damping: last cost above the best, relatively; iterations", "1"
                ),
            ),
        },
        coords={
            "problem": ("problem", names, {"long_name": "problem"}),
            "solver": ("solver", list(methods(config)), {"long_name": "solver"}),
            "near": ("near", np.array(NEAR), named("relative distance to the best cost", "1")),
        },
    )
    return Result(data, config)


def _case(name: str, config: Config) -> Case:
    if name.startswith("pendulum"):
        long = name != "pendulum"
        return pendulum_case(
            4.0 if long else 0.5, config.pendulum_steps if long else config.num_steps
        )
    return arm_case(name.split(",")[0], config.num_steps, stop="stop" not in name)


def figure(result: Result) -> Figure:
    """Draw, for each problem, times relative to ILQR's: here, and in the thesis."""
    data = result.data
    names = list(data.problem.values)
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    tall = 0.6 + 0.28 * data.sizes["solver"]
    fig, axes = jc.plot.panels(rows, columns, size=(2.2 + 2.7 * columns, tall * rows + 0.3))
    for i, ax in enumerate(axes.flat):
        if i >= len(names):
            ax.set_axis_off()
            continue
        with jc.plot.style():
            _draw_times(ax, data.sel(problem=names[i]), names[i])
            ax.set_title(PROBLEMS[names[i]], loc="left")
            ax.set_xlabel("time / ILQR's")
            if i % columns == 0:
                ax.set_ylabel("method")
            else:
                ax.set_yticklabels([])
    with jc.plot.style():
        handles, labels = axes[0, 0].get_legend_handles_labels()
        axes[0, -1].legend(handles, labels, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return fig


def _draw_times(ax: Axes, data: xarray.Dataset, name: str) -> None:
    """Mark the times of one problem, the methods from top to bottom."""
    methods = [str(m) for m in data.solver.values]
    rows = np.arange(len(methods))
    times = data.seconds.values
    # Where ILQR ends in another optimum than the best, it has no time, nor has anyone a ratio.
    for i, near in enumerate(NEAR):
        ratio = times[:, i] / times[methods.index("ILQR"), i]
        ax.plot(ratio, rows, "osD"[i], linestyle="", markersize=6 - i, label=f"here, to {near:g}")
    thesis = THESIS.get(name, {})
    there = [thesis[m][0] / thesis["ILQR"][0] if m in thesis else np.nan for m in methods]
    look = {"markersize": 9, "markerfacecolor": "none", "color": "0.5", "linestyle": ""}
    ax.plot(there, rows, "o", label="thesis", **look)
    for row, method in enumerate(methods):
        if method in thesis and thesis[method][0] == LOWER_BOUND:
            beyond = there[row] * np.array([1.25, 1.8])
            ax.plot(beyond, [row, row], "->", color="0.5", markevery=[1])
    for row in rows:
        if np.isnan(times[row]).all():
            excess = data.cost.values[row] / float(data.best) - 1
            ax.annotate(
                f"ends {excess:.0%} above" if excess < 100 else "fails", (0.98, row + 0.33),
                xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=7,
                color="0.35",
            )  # fmt: skip
    ax.set_xscale("log")
    ax.axvline(1, color="0.8", zorder=0)
    ax.set_yticks(rows, methods)
    ax.set_ylim(len(methods) - 0.5, -0.5)


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its table 4.1."""
    return _table_4_1_claims.claims(result.data, THESIS, PROBLEMS)


def table(result: Result) -> list[tuple[str, ...]]:
    """Return the table as rows of text, a head first, the thesis's columns beside ours."""
    return _table_4_1_claims.table(result.data, THESIS, PROBLEMS)
