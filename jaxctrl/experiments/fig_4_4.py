"""Figure 4.4 of Li (2006): ILQR on both arms from 100 random controls, and who finds the best.

The thesis says that half of the starts of the muscle arm end in the global minimum, and not how
they were drawn. The answer depends on that: drawn here is the fraction over the amplitude of the
starts, each with its 95 % interval (Wilson), beside the paths at the reference amplitudes, N(0, 1)
N m for torques and U[0, 0.3] for muscles, smooth in time. The best cost is the lowest of all starts
of all amplitudes, continued by DDP. "Converging to it" is a matter of the tolerance where optima
lie close together: with muscles they do, and two tolerances are shown, 1e-2 and 1e-4.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

import jaxctrl as jc

from ._chapter_4 import START, TARGET, Case, arm_case, paths_of, random_controls, timed
from ._result import Claim, Result, named

AMPLITUDES = {"torque": (0.1, 0.3, 1.0, 3.0, 5.0, 10.0), "muscle": (0.03, 0.1, 0.3, 0.5, 0.7, 1.0)}
REFERENCE = 2
NEAR = (1e-2, 1e-4)
SHOWN = (0, 2)
"""Iterations whose paths are drawn, before the last one."""
RING = {"marker": "o", "markersize": 8, "markerfacecolor": "none", "zorder": 5}


@dataclass(frozen=True)
class Config:
    """Settings: number of starts for each amplitude, time steps, limit of iterations, and seed."""

    starts: int = 100
    num_steps: int = 100
    max_steps: int = 500
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with few starts and a coarser time step."""
        return cls(starts=3, num_steps=20, max_steps=100)


class _Cloud(NamedTuple):
    """The last costs (amplitude, start), whether converged, and paths at the reference amplitude.

    Paths are (shown iterations, the last one and the last one from the widest starts; start, time,
    joint).
    """

    cost: np.ndarray
    ok: np.ndarray
    paths: np.ndarray
    best: float


def run(config: Config) -> Result:
    """Solve from all starts; arrays lead with the arm, then the amplitude, then the start."""
    clouds = {
        kind: _cloud(arm_case(kind, config.num_steps), AMPLITUDES[kind], config)
        for kind in AMPLITUDES
    }
    data = xarray.Dataset(
        {
            "excess": (
                ("arm", "level", "start"),
                np.stack([cloud.cost / cloud.best - 1 for cloud in clouds.values()]),
                named("last cost above the best one, relatively", "1"),
            ),
            "ok": (
                ("arm", "level", "start"),
                np.stack([cloud.ok for cloud in clouds.values()]),
                named("whether the solver converged", "1"),
            ),
            "best": (
                "arm",
                np.array([cloud.best for cloud in clouds.values()]),
                named("lowest cost found from any start", "1"),
            ),
            "paths": (
                ("arm", "iteration", "start", "time", "joint"),
                np.stack([cloud.paths for cloud in clouds.values()]),
                named("joint angles", "rad"),
            ),
            "amplitude": (
                ("arm", "level"),
                np.array(list(AMPLITUDES.values())),
                named("amplitude of the starts", "N m; 1"),
            ),
        },
        coords={
            "arm": ("arm", list(AMPLITUDES), {"long_name": "arm"}),
            "iteration": (
                "iteration",
                [*(f"iteration {count}" for count in SHOWN), "last", "last, widest starts"],
                {"long_name": "iteration from the reference starts, or the last one"},
            ),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
        },
    )
    return Result(data, config)


def _cloud(case: Case, amplitudes: tuple[float, ...], config: Config) -> _Cloud:
    starts = [
        jnp.asarray(random_controls(case, config.starts, amplitude, config.seed))
        for amplitude in amplitudes
    ]
    found = [
        jc.solve_batch(case.problem, jc.ILQR(), case.x0, us, max_steps=config.max_steps)
        for us in starts
    ]
    cost = np.stack([np.asarray(each.cost) for each in found])
    ok = np.stack([np.asarray(each.status.ok) for each in found])
    level, lane = np.unravel_index(np.argmin(np.where(ok, cost, np.inf)), cost.shape)
    polished, _ = timed(case, jc.DDP())(found[level].us[lane], config.max_steps, 1)
    best = float(min(cost[level, lane], polished))
    ends = [np.asarray(each.xs)[None, ..., :2] for each in (found[REFERENCE], found[-1])]
    paths = np.concatenate([np.asarray(paths_of(case, starts[REFERENCE], SHOWN)), *ends])
    return _Cloud(cost, ok, paths, best)


def _fractions(data: xarray.Dataset, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the fractions (arm, level) at the best cost, and their intervals (arm, level, 2)."""
    hits = (data.excess.values <= near).sum(axis=-1)
    count = data.sizes["start"]
    intervals = [
        [binomtest(int(k), count).proportion_ci(method="wilson") for k in row] for row in hits
    ]
    return hits / count, np.array([[(each.low, each.high) for each in row] for row in intervals])


def figure(result: Result) -> Figure:
    """Draw the clouds of paths over the iterations, and the fraction over the amplitude."""
    data = result.data
    fig, axes = jc.plot.panels(2, len(SHOWN) + 3, size=(13.0, 5.2))
    for row, (arm, name) in enumerate((("torque", "A  torques"), ("muscle", "B  six muscles"))):
        one = data.sel(arm=arm)
        for ax, shown in zip(axes[row], data.iteration.values, strict=False):
            level = -1 if shown == data.iteration.values[-1] else REFERENCE
            order = np.argsort(one.excess.values[level])
            with jc.plot.style():
                _draw_cloud(ax, one.paths.sel(iteration=shown).values[order])
                ax.set_title(f"{name}, {shown}" if ax is axes[row, 0] else shown, loc="left")
        with jc.plot.style():
            axes[row, 0].set_ylabel("elbow [rad]")
            _draw_fractions(axes[row, -1], data, row)
    with jc.plot.style():
        axes[0, 0].legend(loc="upper right")
        axes[0, -1].legend(
            loc="lower left", frameon=True, framealpha=1.0, edgecolor="none", borderaxespad=0.2
        )
    return fig


def _draw_cloud(ax: Axes, paths: np.ndarray) -> None:
    """Draw paths (start, time, joint), sorted by their last cost: light the worse half, on top the
    better one, which hides it where they coincide."""
    half = len(paths) // 2
    looks = (("0.75", paths[half:], "costlier half"), ("black", paths[:half], "cheaper half"))
    for color, group, label in looks:
        for i, path in enumerate(group):
            ax.plot(
                *path.T, color=color, linestyle="-", linewidth=0.5, label=label if i == 0 else None
            )
    ax.plot(*START, "o", markersize=4, color="C0", label="start", zorder=5)
    ax.plot(*TARGET, linestyle="", label="target", color="C1", **RING)
    ax.set_xlabel("shoulder [rad]")


def _draw_fractions(ax: Axes, data: xarray.Dataset, row: int) -> None:
    """Draw the fractions of one arm over the amplitude, with their intervals."""
    amplitude = data.amplitude.values[row]
    for near, marker, size in zip(NEAR, "os", (6, 3.5), strict=True):
        fractions, intervals = _fractions(data, near)
        low, high = np.abs(intervals[row].T - fractions[row])
        ax.errorbar(
            amplitude, fractions[row], (low, high), marker=marker, markersize=size, capsize=2,
            label=f"within {near:g}",
        )  # fmt: skip
    ax.axhline(0.5, color="0.6", linestyle=":", zorder=0, label="thesis, \u201chalf\u201d")
    ax.axvline(amplitude[REFERENCE], color="0.85", zorder=0, label="starts of the paths")
    ax.set_xscale("log")
    ax.set_ylim(-0.03, 1.05)
    ax.set_xlabel(
        "torque of the starts, sd [N m]" if row == 0 else "largest excitation of the starts [1]"
    )
    ax.set_ylabel("fraction at the best cost")


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.4."""
    data, found = result.data, []
    source = "Li (2006), section 4.4 and fig. 4.4"
    loose, intervals = _fractions(data, NEAR[0])
    tight, _ = _fractions(data, NEAR[1])
    for row, arm in enumerate(AMPLITUDES):
        low, high = intervals[row, REFERENCE]
        curve = ", ".join(
            f"{a:g}: {p:.2f} ({q:.2f})"
            for a, p, q in zip(AMPLITUDES[arm], loose[row], tight[row], strict=True)
        )
        found.append(
            Claim(
                f"About half of {data.sizes['start']} random starts of the {arm} arm end in the "
                "best minimum",
                source,
                "0.5",
                f"{loose[row, REFERENCE]:.2f} (95 %: {low:.2f} to {high:.2f}) within {NEAR[0]:g} "
                f"of the best cost; by amplitude, in brackets within {NEAR[1]:g}: {curve}",
                low <= 0.5 <= high,
                "The fraction is the starts' and the tolerance's: the thesis states neither.",
            )
        )
    ok = data.ok.values.mean(axis=-1)
    found.append(
        Claim(
            "The torque arm finds its best minimum at least as often as the muscle arm",
            "Li (2006), fig. 4.4: its cloud is narrower",
            "torque >= muscle at the reference amplitudes",
            f"{loose[0, REFERENCE]:.2f} and {loose[1, REFERENCE]:.2f} within {NEAR[0]:g}; "
            f"{tight[0, REFERENCE]:.2f} and {tight[1, REFERENCE]:.2f} within {NEAR[1]:g}",
            bool(loose[0, REFERENCE] >= loose[1, REFERENCE])
            and bool(tight[0, REFERENCE] >= tight[1, REFERENCE]),
        )
    )
    # One restart finds it with probability p: how many for 99 %.
    worst = float(loose.min())
    enough = np.inf if worst == 0 else np.ceil(np.log(0.01) / np.log1p(-min(worst, 0.99)))
    found.append(
        Claim(
            "A small number of restarts suffices",
            source,
            "few",
            f"at the worst amplitude {worst:.2f} succeed: {enough:.0f} starts for 99 %; the solver "
            f"converged, to whatever optimum, from {ok.min():.2f} to {ok.max():.2f} of the starts",
            bool(enough <= 20),
            "" if enough <= 20 else "Starts this wild are better not used.",
        )
    )
    return found
