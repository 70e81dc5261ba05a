"""What figures 5.3 and 5.10 of Li (2006) share: reaches planned by ILQG from random control laws.

The thesis randomises control laws, not only controls: here each is an open-loop sequence, smooth in
time, with gains on the deviation from the starting posture, constant in time and of random sign and
size. How the thesis drew its laws is not stated, and the answer depends on it: an arm that a law
turns all the way round stays so in what is planned from it, at many times the cost. So laws are
drawn at three amplitudes. Judged is the middle one, our choice, under which the hand strays about
as far as it is to reach, and the elbow of at least nine laws in ten stays within its range. All
directions start from the same laws. The state is known to the controller: the full-observation part
(A) of both figures.

"The best" is the lowest expected cost of a converged solve in that direction, from any law of any
amplitude. Ends are judged over all laws, those included that end in worse optima or not at all.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

import jaxctrl as jc

from . import _chapter_5 as shared
from ._chapter_4 import Case, random_controls
from ._result import Claim, Result, named

REFERENCE = 1
"""Which of the amplitudes is judged."""
NEAR = 0.05
"""How far above the best expected cost a law may end, relatively."""
WITHIN = f"within {100 * NEAR:g} % of the best"
SPREAD = 0.01
"""How far from the target ends may lie [m]."""
ELBOW = (0.0, np.pi)
"""The range of the elbow [rad]."""


@dataclass(frozen=True)
class Settings(shared.Reaches):
    """Settings: those of the reaches, number of laws of each amplitude, standard deviation of the
    gains on angles, as a part of the amplitude of the controls [1/rad], and of those on rates
    [s/rad], limit of iterations, and seed."""

    laws: int = 50
    stiffness: float = 1.0
    damping: float = 0.1
    max_steps: int = 500
    seed: int = 0

    @classmethod
    def quick(cls) -> "Settings":
        """Return settings with few laws and directions."""
        return cls(laws=5, directions=2)


def draw(arm: shared.Arm, problem: jc.Problem, amplitude: float, settings: Settings):
    """Draw random laws of an amplitude [control unit], a batch of `jc.AffinePolicy`."""
    x0 = arm.at_rest(*shared.START)
    us = random_controls(Case(problem, x0), settings.laws, amplitude, settings.seed)
    size = np.zeros(arm.nx)
    size[:2], size[2:4] = settings.stiffness, settings.damping
    rng = np.random.default_rng(settings.seed)
    gains = amplitude * size * rng.standard_normal((settings.laws, 1, arm.nu, arm.nx))
    xs = jnp.broadcast_to(x0, (settings.num_steps + 1, arm.nx))

    def law(u, K):
        K = jnp.broadcast_to(K, (settings.num_steps, *K.shape[1:]))
        return jc.AffinePolicy(xs, u, jnp.zeros_like(u), K, problem.bounds, problem.dt)

    return eqx.filter_vmap(law)(jnp.asarray(us), jnp.asarray(gains))


def all_pairs(problems: jc.Problem, laws: jc.AffinePolicy) -> tuple[jc.Problem, jc.AffinePolicy]:
    """Return batches of every problem with every law, the laws of one problem in a row."""
    count = len(laws.us)
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), problems)
    return repeated, jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(problems.dt)), laws)


def run(arm: shared.Arm, amplitudes: tuple[float, ...], settings: Settings) -> Result:
    """Plan all directions from all laws; arrays lead with the amplitude, direction and law."""
    x0, problems = arm.at_rest(*shared.START), settings.problems(arm)
    one = jax.tree.map(lambda leaf: leaf[0], problems)
    drawn = [draw(arm, one, amplitude, settings) for amplitude in amplitudes]
    laws = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *drawn)
    wild = eqx.filter_vmap(lambda law: jc.simulate(one, law, x0).xs)(laws)
    tasks, starts = all_pairs(problems, laws)
    found = jc.solve_batch(tasks, jc.ILQG(), x0, starts, max_steps=settings.max_steps)

    def planned(values) -> np.ndarray:
        values = np.asarray(values)
        shape = (settings.directions, len(amplitudes), settings.laws, *values.shape[1:])
        return np.moveaxis(values.reshape(shape), 0, 1)

    def strays(xs) -> np.ndarray:
        return ((xs[..., 1] < ELBOW[0]) | (xs[..., 1] > ELBOW[1])).any(axis=-1)

    hand = jax.vmap(jax.vmap(arm.hand))
    first = np.asarray(wild).reshape(len(amplitudes), settings.laws, *wild.shape[1:])
    of_laws, lanes = ("amplitude", "law"), ("amplitude", "direction", "law")
    data = {
        "first": (
            (*of_laws, "time", "axis"),
            np.asarray(hand(wild)).reshape(*first.shape[:3], 2),
            named("hand position under a random law", "m"),
        ),
        "first_strays": (
            of_laws,
            strays(first),
            named("whether the elbow leaves its range under the law", "1"),
        ),
        "hand": (
            (*lanes, "time", "axis"),
            planned(hand(found.xs)),
            named("planned hand position", "m"),
        ),
        "strays": (
            lanes,
            strays(planned(found.xs)),
            named("whether the elbow leaves its range in the plan", "1"),
        ),
        "cost": (lanes, planned(found.expected_cost), named("expected cost", "1")),
        "ok": (lanes, planned(found.status.ok), named("whether the solver converged", "1")),
        "iterations": (lanes, planned(found.num_steps), named("iterations", "1")),
        "target": (("direction", "axis"), settings.targets(arm), named("target", "m")),
    }
    unit = "N m" if one.bounds is None else "1"
    coords = settings.coordinates()
    name = named("amplitude of the laws' controls", unit)
    coords["amplitude"] = ("amplitude", list(amplitudes), name)
    return Result(xarray.Dataset(data, coords), settings)


def _excess(data: xarray.Dataset) -> np.ndarray:
    """Return how far above the best of its direction each expected cost is, relatively; infinite
    where the solver has not converged. Shape (amplitude, direction, law)."""
    cost = np.where(data.ok.values.astype(bool), data.cost.values, np.inf)
    best = cost.min(axis=(0, 2), keepdims=True)
    return cost / best - 1


def _fraction(near: np.ndarray) -> tuple[float, float, float]:
    """Return which part of the laws is near, and the ends of its 95 % interval (Wilson)."""
    interval = binomtest(int(near.sum()), near.size).proportion_ci(method="wilson")
    return float(near.mean()), interval.low, interval.high


def figure(result: Result) -> Figure:
    """Draw the paths under the laws above those planned from them, and how many find the best."""
    data = result.data
    fig, axes = jc.plot.panels(2, data.sizes["amplitude"] + 1, size=(11.5, 5.8))
    unit = "N m" if data.amplitude.units == "N m" else "(excitation)"
    near = _excess(data) <= NEAR
    with jc.plot.style():
        for i, amplitude in enumerate(data.amplitude.values):
            one = data.isel(amplitude=i)
            top, bottom = axes[:, i]
            title = f"{'ABC'[i]}  laws of {amplitude:g} {unit}" + ", judged" * (i == REFERENCE)
            _draw_paths(top, one.first.values, "C0", "under a random law")
            top.set_title(title, loc="left")
            _draw_paths(bottom, one.hand.values[~near[i]], "0.7", "planned, worse or not converged")
            _draw_paths(bottom, one.hand.values[near[i]], "k", f"planned, {WITHIN}")
            bottom.set_title("planned from them", loc="left")
            for ax in axes[:, i]:
                _draw_start(ax, one.first.values[0, 0])
            bottom.plot(
                *(100 * data.target.values.T), "o", color="C1", markersize=8, zorder=5,
                markerfacecolor="none", linestyle="", label="target", clip_on=False,
            )  # fmt: skip
        marks = {}
        for ax in (axes[0, 1], axes[1, -2]):  # the wildest laws, from which all kinds of plans are
            handles, labels = ax.get_legend_handles_labels()
            marks |= dict(zip(labels, handles, strict=True))
        fig.legend(list(marks.values()), list(marks), loc="outside lower center", ncols=5)
        _draw_fractions(axes[0, -1], data)
        _draw_costs(axes[1, -1], data)
    return fig


def _draw_paths(ax: Axes, paths: np.ndarray, color: str, label: str) -> None:
    """Draw hand paths (n, time, axis) [m]."""
    for i, path in enumerate(100 * paths):
        ax.plot(*path.T, color=color, linestyle="-", linewidth=0.6, label=label if i == 0 else None)


def _draw_start(ax: Axes, start: np.ndarray) -> None:
    """Draw the start (2,) [m], and the axes of a plane."""
    ax.plot(*(100 * start), "s", color="C1", markersize=4, zorder=6, label="start", linestyle="")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [cm]")
    ax.set_ylabel("y [cm]")


def _draw_fractions(ax: Axes, data: xarray.Dataset) -> None:
    """Draw for each amplitude and direction which part of the laws finds the best, and how many
    keep the elbow within its range."""
    near = _excess(data) <= NEAR
    angles = np.radians(data.direction.values)
    amplitudes = data.amplitude.values
    for i, color in enumerate(jc.plot.direction_colours(angles)):
        found = np.array([_fraction(each[i]) for each in near])
        beside = 1.04 ** (i - (len(angles) - 1) / 2)  # so that they do not hide each other
        bars = np.abs(found[:, 1:].T - found[:, 0])
        ax.errorbar(
            beside * amplitudes, found[:, 0], bars, fmt="o", color=color, markersize=3, capsize=1.5,
            linewidth=0.8, label="one direction, 95 %" if i == 0 else None,
        )  # fmt: skip
    kept = 1 - data.first_strays.values.mean(axis=1)
    ax.plot(amplitudes, kept, "k--", marker="x", label="laws that keep the elbow in range")
    ax.set_xscale("log")
    ax.set_xticks(amplitudes, [f"{each:g}" for each in amplitudes])
    ax.minorticks_off()
    ax.set_ylim(0, 1.05)
    ax.set_xlabel("amplitude of the laws" + " [N m]" * (data.amplitude.units == "N m"))
    ax.set_ylabel(f"fraction {WITHIN}")
    ax.legend(loc="lower left", bbox_to_anchor=(0.02, 0.02))


def _draw_costs(ax: Axes, data: xarray.Dataset) -> None:
    """Draw how far above the best each law of the judged amplitude ends, by its rank."""
    excess = np.sort(100 * np.maximum(_excess(data)[REFERENCE], 1e-10), axis=1)
    ranks = np.arange(1, excess.shape[1] + 1)
    colours = jc.plot.direction_colours(np.radians(data.direction.values))
    for values, color in zip(excess, colours, strict=True):
        ax.semilogy(ranks, values, color=color, linestyle="-", linewidth=1)
    ax.axhline(100 * NEAR, color="0.5", linestyle=":", label=f"{100 * NEAR:g} %")
    ax.set_title("expected costs", loc="left")
    ax.set_xlabel(f"rank of the law ({'ABC'[REFERENCE]})")
    ax.set_ylabel("expected cost above the best [%]")
    ax.legend(loc="upper left", bbox_to_anchor=(0.02, 1.0))


def claims(result: Result, source: str) -> list[Claim]:
    """Count the laws that lead to the best cost, and measure where what is planned ends."""
    return [_best(result.data, source), _ends(result.data, source)]


def _best(data: xarray.Dataset, source: str) -> Claim:
    near = _excess(data) <= NEAR
    found = [_fraction(each) for each in near[REFERENCE]]
    worst = min(found)
    holds = worst[1] > 0.5
    by_amplitude = ", ".join(
        f"{amplitude:g}: {part:.3f} ({1 - away:.2f})"
        for amplitude, part, away in zip(
            data.amplitude.values,
            near.mean(axis=(1, 2)),
            data.first_strays.values.mean(axis=1),
            strict=True,
        )
    )
    lost = ~near & data.ok.values.astype(bool)
    turned = data.strays.values[lost].mean() if lost.any() else 0.0
    return Claim(
        "Most random laws lead to the best expected cost, in each direction",
        source,
        f"within {100 * NEAR:g} % of it, the 95 % interval above one half in each direction",
        f"{', '.join(f'{part:.2f}' for part, _, _ in found)} by direction, the least in "
        f"{worst[1]:.2f} to {worst[2]:.2f}; {data.ok.values[REFERENCE].mean():.3f} converged, in "
        f"{np.median(data.iterations.values[REFERENCE]):.0f} iterations (median). By amplitude, in "
        f"brackets the part of the laws that keep the elbow in its range: {by_amplitude}. "
        f"Of the plans in worse optima {turned:.2f} turn the elbow out of it",
        holds,
        "" if holds else "The fraction depends on how wild the laws are, or they are too few.",
    )


def _ends(data: xarray.Dataset, source: str) -> Claim:
    one = data.isel(amplitude=REFERENCE)
    apart = np.linalg.norm(one.hand.values[:, :, -1] - one.target.values[:, None], axis=-1)
    excess = _excess(data)[REFERENCE]
    lane = excess.argmin(axis=1)
    bundle = np.take_along_axis(one.hand.values, lane[:, None, None, None], axis=1)
    away = np.linalg.norm(one.hand.values - bundle, axis=-1).max(axis=-1)[excess <= NEAR]
    holds = bool((apart < SPREAD).all())
    return Claim(
        "All planned paths end within a centimetre of their targets",
        source,
        f"less than {100 * SPREAD:g} cm from them",
        f"at most {1e3 * apart.max():.3g} mm; {(apart < SPREAD).mean():.3f} of all are nearer. "
        f"The paths near the best cost are nowhere further than {1e3 * away.max():.2g} mm apart "
        "from the best one",
        holds,
        "" if holds else "Laws that end in worse optima, or have not converged, end elsewhere.",
    )
