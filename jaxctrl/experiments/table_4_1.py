"""Table 4.1 of Li (2006): time and iterations of ILQR and its rivals on three problems.

One rule for all: the time from the start until the iterate's cost is within a tolerance of the best
cost known, which is the lowest of all methods and of ILQR, continued by DDP, from random controls.
All start from the plant's nominal control (no torque; excitations of 0.05) under the same bounds;
the thesis states neither its start nor its stopping rule. Three tolerances are shown: with muscles
optima lie within 1e-3 of one another, and a solver that settles in another than the best one never
comes within 1e-4. Cost (4.20) is taken with the stopping term, that the thesis's text asks for, and
as printed, without it. Times are warm, by the processor's clock on one core, of all methods in
turns, and of solves that follow one another inside one compiled call: the call itself takes longer
than the torque arm's solve.

The methods are the package's own: ILQR; DDP, which begins with Gauss-Newton steps; nonlinear
conjugate gradients with a strong-Wolfe search (the thesis's CGD); L-BFGS, which the thesis does not
have; and collocation of Pontryagin's boundary-value problem (its ODE), whose controls are put on
the grid and judged there: it solves the problem in continuous time, so it need not come near.
"""

from dataclasses import dataclass

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _table_4_1_claims
from ._chapter_4 import Case, arm_case, pendulum_case
from ._result import Claim, Result, named
from ._table_4_1_claims import LOWER_BOUND
from ._table_4_1_runs import METHODS, NEAR, measure

PROBLEMS = {
    "torque": "torque arm",
    "muscle": "muscle arm",
    "pendulum": "pendulum",
    "torque, no stop": "torque arm, (4.20) as printed",
    "muscle, no stop": "muscle arm, (4.20) as printed",
}
"""Each problem's name in full."""
THESIS = {
    "torque": {"ILQR": (0.41, 6), "DDP": (2.65, 15), "CG": (8.86, 17), "BVP": (11.20, np.nan)},
    "muscle": {
        "ILQR": (8.31, 8),
        "DDP": (181.39, 15),
        "CG": (91.14, 14),
        "BVP": (LOWER_BOUND, np.nan),
    },
    "pendulum": {"ILQR": (0.26, 5), "DDP": (1.61, 20), "CG": (4.95, 9), "BVP": (6.33, np.nan)},
}
"""Seconds and iterations of the table."""


@dataclass(frozen=True)
class Config:
    """Settings: the problems, separated by semicolons; time steps of the arms and the pendulum;
    limit of iterations; number of random starts in the search for the best cost; repetitions of
    each timing; seed."""

    problems: str = "torque; muscle; pendulum; torque, no stop; muscle, no stop"

    num_steps: int = 100
    pendulum_steps: int = 400
    max_steps: int = 3000
    starts: int = 60
    repeats: int = 15
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings for the pendulum alone, coarser, less patient and without a search."""
        return cls("pendulum", pendulum_steps=100, max_steps=200, starts=0, repeats=2)

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
    found = [measure(_case(name, config), config) for name in names]
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
            "seconds": reached("seconds", "median warm processor time until so near", "s"),
            "spread": reached("spread", "half the interquartile range of that time", "s"),
            "wall": reached("wall", "median warm wall time until so near", "s"),
            "iterations": reached("iterations", "iterations until so near", "1"),
            "first": each(
                "first", "wall time of the first call, with compilation, to the end", "s"
            ),
            "best": ("problem", np.array([best for _, best, _ in found]), named("best cost", "1")),
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
            "solver": ("solver", list(METHODS), {"long_name": "solver"}),
            "near": ("near", np.array(NEAR), named("relative distance to the best cost", "1")),
        },
    )
    return Result(data, config)


def _case(name: str, config: Config) -> Case:
    if name == "pendulum":
        return pendulum_case(config.pendulum_steps)
    return arm_case(name.split(",")[0], config.num_steps, stop="stop" not in name)


def figure(result: Result) -> Figure:
    """Draw, for each problem, times relative to ILQR's: here, and in the thesis."""
    data = result.data
    shown = [name for name in data.problem.values if name in THESIS] or list(data.problem.values)
    fig, axes = jc.plot.panels(1, len(shown), size=(1.0 + 3.0 * len(shown), 2.9))
    for ax, name in zip(axes[0], shown, strict=True):
        with jc.plot.style():
            _draw_times(ax, data.sel(problem=name), name)
            ax.set_title(PROBLEMS[name], loc="left")
            ax.set_xlabel("time / ILQR's")
    with jc.plot.style():
        axes[0, 0].set_ylabel("method")
        axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return fig


def _draw_times(ax: Axes, data: xarray.Dataset, name: str) -> None:
    """Mark the times of one problem, the methods from top to bottom."""
    rows = np.arange(len(METHODS))
    base = data.seconds.sel(solver="ILQR").values
    for i, near in enumerate(NEAR):
        ratio = data.seconds.values[:, i] / base[i]
        ax.plot(ratio, rows, "osD"[i], markersize=6 - i, label=f"here, within {near:g}")
    thesis = THESIS.get(name, {})
    there = [thesis[m][0] / thesis["ILQR"][0] if m in thesis else np.nan for m in METHODS]
    ax.plot(there, rows, "o", markersize=9, markerfacecolor="none", color="0.5", label="thesis")
    for row, method in enumerate(METHODS):
        if method in thesis and thesis[method][0] == LOWER_BOUND:
            beyond = there[row] * np.array([1.25, 1.8])
            ax.plot(beyond, [row, row], "->", color="0.5", markevery=[1])
    for row in rows:
        if np.isnan(data.seconds.values[row]).all():
            excess = data.cost.values[row] / float(data.best) - 1
            ax.annotate(
                f"ends {excess:.0%} above" if excess < 100 else "fails", (0.98, row + 0.33),
                xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=7,
                color="0.35",
            )  # fmt: skip
    ax.set_xscale("log")
    ax.axvline(1, color="0.8", zorder=0)
    ax.set_yticks(rows, METHODS)
    ax.set_ylim(len(METHODS) - 0.5, -0.5)


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its table 4.1."""
    return _table_4_1_claims.claims(result.data, THESIS, PROBLEMS)


def table(result: Result) -> list[tuple[str, ...]]:
    """Return the table as rows of text, a head first, the thesis's columns beside ours."""
    return _table_4_1_claims.table(result.data, THESIS, PROBLEMS)
