"""Figure 4.2 of Li (2006): joint paths of the muscle-driven arm over the iterations of ILQR.

A: cost (4.20) with the stopping term that the thesis's text asks for; B: as printed, without it;
both in the thesis's axes, which cut what leaves them. The thesis starts "from poor initial
control - which produces an arbitrary movement" and does not print it. Here each muscle starts with
a constant excitation drawn from U[0, amplitude] (our choice). What counts as converged is not
printed either: reported is the iteration at which 95 % of the whole drop of the cost is reached.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._chapter_4 import COSTS, TARGET, WINDOW, arm_case, outside, paths_of
from ._result import Claim, Result, named

SHOWN = 9


@dataclass(frozen=True)
class Config:
    """Settings: duration [s], time steps, weight and amplitude of the start, and its seed."""

    duration: float = 0.5
    num_steps: int = 100
    effort: float = 1e-4
    amplitude: float = 0.3
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with a coarser time step."""
        return cls(num_steps=20)


def run(config: Config) -> Result:
    """Solve under both costs, and keep the path of each of the first iterations."""
    levels = config.amplitude * jax.random.uniform(jax.random.key(config.seed), (6,))
    us = jnp.broadcast_to(levels, (config.num_steps, 6))
    given = {"duration": config.duration, "effort": config.effort}
    paths, solutions = [], []
    for cost in COSTS:
        case = arm_case("muscle", config.num_steps, stop=cost == "stop", **given)
        solutions.append(jc.solve(case.problem, jc.ILQR(), case.x0, us))
        paths.append(np.asarray(paths_of(case, us[None], tuple(range(SHOWN))))[:, 0])
    count = max(int(solution.num_steps) for solution in solutions) + 1
    failed = [each.status.message for each in solutions if not bool(each.status.ok)]
    data = xarray.Dataset(
        {
            "angles": (
                ("cost", "iteration", "time", "joint"),
                np.stack(paths),
                named("joint angle", "rad"),
            ),
            "final": (
                ("cost", "time", "joint"),
                np.stack([solution.xs[:, :2] for solution in solutions]),
                named("joint angle at convergence", "rad"),
            ),
            "value": (
                ("cost", "step"),
                np.stack([solution.history.cost[:count] for solution in solutions]),
                named("cost of each iterate", "1") | {"missing": "NaN after the last iterate"},
            ),
        },
        coords={
            "time": ("time", np.asarray(case.problem.ts), named("time", "s")),
            "cost": ("cost", list(COSTS), {"long_name": "cost (4.20), and with a stopping term"}),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
        },
    )
    return Result(data, config, "; ".join(failed))


def figure(result: Result) -> Figure:
    """Draw elbow against shoulder for the first iterations, and the fall of the cost."""
    data = result.data
    fig, axes = jc.plot.panels(1, 3, size=(11.0, 3.0))
    for ax, letter, (cost, words) in zip(axes[0], "AB", COSTS.items(), strict=False):
        paths = data.angles.sel(cost=cost).values
        jc.plot.joint_paths(paths, target=TARGET, ax=ax)
        with jc.plot.style():
            ax.set_xlim(*WINDOW[:, 0])
            ax.set_ylim(*WINDOW[:, 1])
            beyond = outside(paths, WINDOW)
            cut = "\ncut by the axes: " + beyond.replace(", ", ",\n") if beyond else ""
            ax.set_xlabel("shoulder [rad]" + cut)
            ax.text(-0.02, 1.42, f"{letter}  {words}", transform=ax.transAxes)
            if letter == "A":  # both panels have one legend, which would squeeze them
                ax.get_legend().remove()
    ax = axes[0, 2]
    with jc.plot.style():
        for i, (cost, words) in enumerate(COSTS.items()):
            value = data.value.sel(cost=cost).values
            value = value[np.isfinite(value)]
            ax.semilogy(
                value[:-1] - value[-1], marker=".", linestyle=("-", "--")[i], color=f"C{i}",
                label=words,
            )  # fmt: skip
        ax.set_title("C", loc="left")
        ax.set_xlabel("iteration")
        ax.set_ylabel("cost above the final one [1]")
        ax.legend(loc="upper right")
    return fig


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.2."""
    return [claim for cost in COSTS for claim in _of(result.data.sel(cost=cost), COSTS[cost])]


def _of(data: xarray.Dataset, words: str) -> list[Claim]:
    """Return the claims about one of the costs."""
    cost = data.value.values
    cost = cost[np.isfinite(cost)]
    reached = int(np.argmax(cost[0] - cost >= 0.95 * (cost[0] - cost[-1])))
    error = float(np.abs(data.final.values[-1] - TARGET).max())
    at_5 = float(np.abs(data.angles.values[5, -1] - TARGET).max())
    beyond, start = outside(data.final.values, WINDOW), outside(data.angles.values, WINDOW)
    return [
        Claim(
            f"The cost falls in every iteration, {words}",
            "Li (2006), section 4.3.2",
            "monotone",
            f"largest rise {max(0.0, float(np.diff(cost).max())):.1e}",
            bool((np.diff(cost) <= 0).all()),
        ),
        Claim(
            f"A good control is found in about 5 iterations, {words}",
            "Li (2006), section 4.3.2",
            "about 5",
            f"95 % of the cost's drop after {reached}; the joints are off by {at_5:.3f} rad "
            f"after 5; converged after {cost.size - 1}",
            reached <= 7,
            "The thesis states neither its start nor its stopping rule.",
        ),
        Claim(
            f"The converged movement ends at (1, 1.5) rad, {words}",
            "Li (2006), fig. 4.2",
            "within 0.01 rad",
            f"largest error {error:.1e} rad",
            error < 0.01,
        ),
        Claim(
            f"The converged path stays within the figure's axes, {words}",
            "Li (2006), fig. 4.2",
            "shoulder 0.95 to 1.55, elbow 1.3 to 1.6 rad",
            f"{beyond or 'inside'}; all iterations: {start or 'inside'}",
            not beyond,
            "The thesis states neither its start nor which of the costs it has." * bool(beyond),
        ),
    ]
