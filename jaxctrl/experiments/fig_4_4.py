"""Figure 4.4 of Li (2006): ILQR on both arms from 100 random controls, and who finds the best.

The thesis says that half of the starts of the muscle arm end in the global minimum, and not how
they were drawn. The answer depends on that: drawn here is the fraction over the amplitude of the
starts, each with its 95 % interval (Wilson), beside the paths at the reference amplitudes, N(0, 1)
N m for torques and U[0, 0.3] for muscles, smooth in time. It also depends on when the iteration
ends: the fraction after 8 iterations, the thesis's number on the muscle arm (table 4.1), is beside
that at convergence. The best cost is the lowest of all starts of all amplitudes, continued by DDP.
"Converging to it" is a matter of the tolerance where optima lie close together: two are shown, 1e-2
and 1e-4. Each arm has cost (4.20) as printed and with the stopping term that the text asks for.
The paths are in the thesis's axes, which cut what leaves them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

import jaxctrl as jc

from ._chapter_4 import (
    COSTS,
    START,
    TARGET,
    WINDOW,
    Case,
    arm_case,
    iterate,
    outside,
    paths_of,
    random_controls,
)
from ._result import Claim, Result, named

AMPLITUDES = {"torque": (0.1, 0.3, 1.0, 3.0, 5.0, 10.0), "muscle": (0.03, 0.1, 0.3, 0.5, 0.7, 1.0)}
REFERENCE = 2
NEAR = (1e-2, 1e-4)
EARLY = 8
"""The thesis's number of iterations on the muscle arm (table 4.1)."""
SHOWN = (0, 2, EARLY)
"""Iterations whose paths are drawn, before the last one."""
PANELS = [
    (arm, cost, f"{letter}  {name}, {COSTS[cost]}")
    for arm, cost, letter, name in (
        ("torque", "stop", "A", "torques"),
        ("torque", "printed", "B", "torques"),
        ("muscle", "stop", "C", "six muscles"),
        ("muscle", "printed", "D", "six muscles"),
    )
]
SOURCE = "Li (2006), section 4.4 and fig. 4.4"
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
    """The last costs (amplitude, start), those after `EARLY` iterations, whether converged, and
    paths from the reference amplitude (shown iterations and the last one; start, time, joint)."""

    last: np.ndarray
    early: np.ndarray
    ok: np.ndarray
    paths: np.ndarray
    best: float


def run(config: Config) -> Result:
    """Solve from all starts; arrays lead with the arm, the cost, the amplitude, and the start."""
    clouds = [
        [
            _cloud(arm_case(arm, config.num_steps, stop=cost == "stop"), AMPLITUDES[arm], config)
            for cost in COSTS
        ]
        for arm in AMPLITUDES
    ]

    def each(dims: tuple[str, ...], of: Callable[[_Cloud], Any], *names: str):
        values = [[of(cloud) for cloud in row] for row in clouds]
        return ("arm", "cost", *dims), np.array(values), named(*names)

    lanes, above = ("level", "start"), "cost above the best one, relatively"
    data = xarray.Dataset(
        {
            "excess": each(lanes, lambda c: c.last / c.best - 1, f"last {above}", "1"),
            "early": each(
                lanes, lambda c: c.early / c.best - 1, f"after {EARLY} iterations: {above}", "1"
            ),
            "ok": each(lanes, lambda c: c.ok, "whether the solver converged", "1"),
            "best": each((), lambda c: c.best, "lowest cost found from any start", "1"),
            "paths": each(
                ("iteration", "start", "time", "joint"), lambda c: c.paths, "joint angles", "rad"
            ),
            "amplitude": (
                ("arm", "level"),
                np.array(list(AMPLITUDES.values())),
                named("amplitude of the starts", "N m; 1"),
            ),
        },
        coords={
            "arm": ("arm", list(AMPLITUDES), {"long_name": "arm"}),
            "cost": ("cost", list(COSTS), {"long_name": "cost (4.20), and with a stopping term"}),
            "iteration": (
                "iteration",
                [*(f"iteration {count}" for count in SHOWN), "last"],
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
    history = np.stack([np.asarray(each.history.cost) for each in found])
    ends = np.minimum(np.stack([np.asarray(each.num_steps) for each in found]), EARLY)
    early = np.take_along_axis(history, ends[..., None], axis=-1)[..., 0]
    ok = np.stack([np.asarray(each.status.ok) for each in found])
    level, lane = np.unravel_index(np.argmin(np.where(ok, cost, np.inf)), cost.shape)
    limit = jnp.array(config.max_steps)  # no static number: both costs share a program
    polished, _ = iterate(case, jc.DDP(), found[level].us[lane], limit, None)
    best = float(min(cost[level, lane], polished))
    last = np.asarray(found[REFERENCE].xs)[None, ..., :2]
    paths = np.concatenate([np.asarray(paths_of(case, starts[REFERENCE], SHOWN)), last])
    return _Cloud(cost, early, ok, paths, best)


def _fractions(excess: xarray.DataArray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the fractions (level,) of lanes (level, start) near the best cost, and their intervals
    (level, 2)."""
    hits = (excess.values <= near).sum(axis=-1)
    count = excess.sizes["start"]
    intervals = [binomtest(int(k), count).proportion_ci(method="wilson") for k in hits]
    return hits / count, np.array([(each.low, each.high) for each in intervals])


def figure(result: Result) -> Figure:
    """Draw the clouds of paths over the iterations, and the fraction over the amplitude."""
    data = result.data
    fig, axes = jc.plot.panels(len(PANELS), len(SHOWN) + 2, size=(13.0, 8.6))
    for row, (arm, cost, title) in enumerate(PANELS):
        one = data.sel(arm=arm, cost=cost)
        order = np.argsort(one.excess.values[REFERENCE])
        for column, shown in enumerate(data.iteration.values):
            ax, paths = axes[row, column], one.paths.sel(iteration=shown).values[order]
            with jc.plot.style():
                _draw_cloud(ax, paths)
                ax.set_title(f"{title}\n{shown}" if column == 0 else shown, loc="left")
                ax.set_xlabel("shoulder [rad]" if row == len(PANELS) - 1 else "")
                ax.label_outer()
        with jc.plot.style():
            axes[row, 0].set_ylabel("elbow [rad]")
            _draw_fractions(axes[row, -1], one, arm)
    with jc.plot.style():
        axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
        marks = axes[0, 0].get_legend_handles_labels()
        axes[1, -1].legend(*marks, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return fig


def _draw_cloud(ax: Axes, paths: np.ndarray) -> None:
    """Draw paths (start, time, joint), sorted by their last cost: light the worse half, on top the
    better one, which hides it where they coincide; in the thesis's axes."""
    half = len(paths) // 2
    looks = (("0.75", paths[half:], "costlier half"), ("black", paths[:half], "cheaper half"))
    for color, group, label in looks:
        for i, path in enumerate(group):
            ax.plot(
                *path.T, color=color, linestyle="-", linewidth=0.5, label=label if i == 0 else None
            )
    ax.plot(*START, "o", markersize=4, color="C0", label="start", zorder=5)
    ax.plot(*TARGET, linestyle="", label="target", color="C1", **RING)
    beyond = outside(paths, WINDOW)
    if beyond:
        ax.annotate(
            "cut: " + beyond.replace(", ", "\n"), (0.03, 0.05), xycoords="axes fraction",
            fontsize=7, color="0.35", zorder=6,
            bbox={"facecolor": "w", "edgecolor": "none", "pad": 1.5},
        )  # fmt: skip
    ax.set_xlim(*WINDOW[:, 0])
    ax.set_ylim(*WINDOW[:, 1])


def _draw_fractions(ax: Axes, one: xarray.Dataset, arm: str) -> None:
    """Draw the fractions of one arm and cost over the amplitude, with their intervals."""
    amplitude = one.amplitude.values
    for i, (near, marker) in enumerate(zip(NEAR, "os", strict=True)):
        for excess, when in ((one.excess, "converged"), (one.early, f"after {EARLY}")):
            fractions, intervals = _fractions(excess, near)
            low, high = np.abs(intervals.T - fractions)
            done = when == "converged"
            beside = 1.05 ** (2 * i - 1.5 + (not done))  # so that the four do not hide each other
            ax.errorbar(
                beside * amplitude, fractions, (low, high), marker=marker, markersize=5 - i,
                color=f"C{i}", linestyle="-" if done else "--", label=f"to {near:g}, {when}",
                capsize=2, markerfacecolor=f"C{i}" if done else "white",
            )  # fmt: skip
    ax.axhline(0.5, color="0.6", linestyle=":", zorder=0, label="thesis, \u201chalf\u201d")
    ax.axvline(amplitude[REFERENCE], color="0.85", zorder=0, label="starts of the paths")
    ax.set_xscale("log")
    ax.set_ylim(-0.05, 1.08)
    ax.set_xlabel(
        "torque of the starts, sd [N m]" if arm == "torque" else "largest excitation of the starts"
    )
    ax.set_ylabel("fraction at the best cost")


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.4."""
    data, found = result.data, []
    for arm in AMPLITUDES:
        for cost in COSTS:
            one = data.sel(arm=arm, cost=cost)
            found += [_half(one, one.excess, "at convergence")]
            found += [_half(one, one.early, f"after {EARLY} iterations"), _inside(one)]
    for cost in COSTS:
        found += [_torques_more_often(data.sel(cost=cost)), _restarts(data.sel(cost=cost))]
    return found


def _half(one: xarray.Dataset, excess: xarray.DataArray, when: str) -> Claim:
    loose, intervals = _fractions(excess, NEAR[0])
    tight, _ = _fractions(excess, NEAR[1])
    low, high = intervals[REFERENCE]
    curve = ", ".join(
        f"{a:g}: {p:.2f} ({q:.2f})"
        for a, p, q in zip(one.amplitude.values, loose, tight, strict=True)
    )
    return Claim(
        f"About half of {one.sizes['start']} random starts of the {one.arm.item()} arm end in the "
        f"best minimum {when}, {COSTS[one.cost.item()]}",
        SOURCE,
        "0.5",
        f"{loose[REFERENCE]:.2f} (95 %: {low:.2f} to {high:.2f}) within {NEAR[0]:g} of the best "
        f"cost; by amplitude, in brackets within {NEAR[1]:g}: {curve}",
        low <= 0.5 <= high,
        "The fraction is the starts' and the tolerance's: the thesis states neither.",
    )


def _inside(one: xarray.Dataset) -> Claim:
    paths = one.paths.sel(iteration="last").values
    count = sum(not outside(path, WINDOW) for path in paths)
    return Claim(
        f"The {one.arm.item()} arm's converged paths stay within the figure's axes, "
        f"{COSTS[one.cost.item()]}",
        "Li (2006), fig. 4.4",
        "shoulder 0.95 to 1.55, elbow 1.3 to 1.6 rad",
        f"{count} of {len(paths)}, from the reference starts; {outside(paths, WINDOW) or 'all in'}",
        count == len(paths),
        "" if count == len(paths) else "The thesis states neither its start nor which of the costs "
        "it has.",
    )  # fmt: skip


def _torques_more_often(data: xarray.Dataset) -> Claim:
    torque, muscle = (
        [_fractions(data.excess.sel(arm=arm), near)[0][REFERENCE] for near in NEAR]
        for arm in ("torque", "muscle")
    )
    return Claim(
        "The torque arm finds its best minimum at least as often as the muscle arm, "
        f"{COSTS[data.cost.item()]}",
        "Li (2006), fig. 4.4: its cloud is narrower",
        "torque >= muscle at the reference amplitudes",
        "; ".join(
            f"{a:.2f} and {b:.2f} within {near:g}"
            for a, b, near in zip(torque, muscle, NEAR, strict=True)
        ),
        all(a >= b for a, b in zip(torque, muscle, strict=True)),
        "The arms' starts are not the same ones, and their amplitudes not alike.",
    )


def _restarts(data: xarray.Dataset) -> Claim:
    # One restart finds it with probability p: how many for 99 %.
    worst = min(float(_fractions(data.excess.sel(arm=arm), NEAR[0])[0].min()) for arm in AMPLITUDES)
    enough = np.inf if worst == 0 else np.ceil(np.log(0.01) / np.log1p(-min(worst, 0.99)))
    ok = data.ok.values.mean(axis=-1)
    return Claim(
        f"A small number of restarts suffices, {COSTS[data.cost.item()]}",
        SOURCE,
        "few",
        f"at the worst amplitude {worst:.2f} succeed: {enough:.0f} starts for 99 %; the solver "
        f"converged, to whatever optimum, from {ok.min():.2f} to {ok.max():.2f} of the starts",
        bool(enough <= 20),
        "" if enough <= 20 else "Starts this wild are better not used.",
    )
