"""Two claims of section 5.1 of Li (2006), put to the test on reaches of the torque arm by ILQG.

Point 1: noise that grows with the controls "turns out to have an effect similar to an energy cost".
So it alone, without effort, should give a minimum, with finite and smooth torques; without noise
there is none. All reaches are planned from several starts and with steps of half the length, too.
A minimum is unique if the torques from all starts agree within 1 % of their RMS, and smooth if
halving the time step changes them by less than 10 %: torques that follow the step's length are no
function of time. Both bounds are ours.

Point 3: where the Hessian is fixed, the recursion should take that into account (`_recursions`).
ILQG starts from random laws (`_random_laws`), with the true and with the fixed Hessian in its
recursion: undamped at first, as our solvers are, and damped from the start, as the thesis's.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _chapter_5 as shared, _random_laws as random_laws, _recursions as recursions
from ._chapter_4 import Case, random_controls
from ._result import Claim, Result, named

FACTORS = (1.0, 2.5, 5.0, 15.0, 50.0)
"""Noises of point 1, in units of `motor_noise`."""
STRONG = 3
"""Which of them is strong: with 0.02 s^(1/2), thrice each torque over 10 ms."""
AMPLITUDE = 0.3
"""Standard deviation of the torques from which the reaches of point 1 start, too [N m]."""
UNIQUE, SMOOTH = 0.01, 0.1
"""How far torques from other starts, and those of half the step, may be off, relative to their
RMS."""
GRIDS = (1, 2)
SOURCE = "Li (2006), section 5.1"


@dataclass(frozen=True)
class Config(random_laws.Settings):
    """Settings: those of `_random_laws`, and the number of starts of each reach of point 1."""

    starts: int = 4

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with few directions, laws and steps."""
        return cls(laws=10, directions=2, num_steps=25, starts=2)


def run(config: Config) -> Result:
    """Plan without effort under several noises, and with two recursions from random laws."""
    arm = jc.plants.TorqueArm()
    noises = config.motor_noise * np.array(FACTORS)
    cases = {"effort alone": (config.effort, None), "neither": (0.0, None)}
    cases |= {f"noise {noise:.3g}": (0.0, noise) for noise in noises}
    found = [[_effortless(arm, config, grid, *case) for grid in GRIDS] for case in cases.values()]
    coarse, fine = zip(*found, strict=True)
    torques = np.stack([each["us"][:, 0] for each in coarse])
    halves = np.stack([each["us"][:, 0] for each in fine])
    means = halves.reshape(*torques.shape[:2], -1, 2, torques.shape[-1]).mean(axis=3)
    ways, grids = ("case", "direction"), ("grid", "case", "direction")

    def both(name: str):
        return np.array([[each[name] for each in row] for row in (coarse, fine)])

    data = {
        "torque": (
            (*ways, "step", "joint"),
            torques,
            named("planned torque, from rest and the longer step", "N m"),
        ),
        "peak": (grids, both("peak"), named("largest torque", "N m")),
        "energy": (grids, both("energy"), named("integral of the squared torques", "N^2 m^2 s")),
        "apart": (
            grids,
            both("apart"),
            named("largest distance of torques from other starts, relative to their RMS", "1"),
        ),
        "refined": (
            ways,
            _rms(means - torques) / _rms(torques),
            named("change of the torques by halving the step, relative to their RMS", "1"),
        ),
        "ok": (grids, both("ok"), named("fraction of the starts that converged", "1")),
        "cost": (grids, both("cost"), named("cost, under noise the expected one", "1")),
    } | recursions.run(arm, config)
    coords = (
        config.coordinates("step")
        | {
            "case": ("case", list(cases), {"long_name": "what prices the torques"}),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
            "grid": (
                "grid",
                config.duration / config.num_steps / np.array(GRIDS),
                named("step", "s"),
            ),
        }
        | recursions.coordinates()
    )
    return Result(xarray.Dataset(data, coords), config)


def _rms(torques: np.ndarray) -> np.ndarray:
    """Return the root mean square of torques (..., time, joint) over both, (...)."""
    return np.sqrt((torques**2).mean(axis=(-2, -1)))


def _effortless(arm, config: Config, grid: int, effort: float, noise: float | None) -> dict:
    """Reach in all directions from all starts, at a price of effort and under a noise, or none.

    Returns: torques `us` (direction, start, time, joint), and what each direction comes to.
    """
    x0, steps = arm.at_rest(*shared.START), grid * config.num_steps
    problems = config.problems(arm, num_steps=steps, effort=effort, motor_noise=noise)
    one = jax.tree.map(lambda leaf: leaf[0], problems)
    others = random_controls(Case(one, x0), config.starts - 1, AMPLITUDE, config.seed)
    starts = np.concatenate([np.zeros((1, steps, arm.nu)), others])
    found = jc.solve_batch(
        jax.tree.map(lambda leaf: jnp.repeat(leaf, config.starts, axis=0), problems),
        jc.ILQR() if noise is None else jc.ILQG(),
        x0,
        jnp.asarray(np.tile(starts, (config.directions, 1, 1))),
    )
    shape = (config.directions, config.starts)
    us = np.asarray(found.us).reshape(*shape, steps, arm.nu)
    cost = found.cost if noise is None else found.expected_cost
    return {
        "us": us,
        "peak": np.abs(us[:, 0]).max(axis=(1, 2)),
        "energy": (us[:, 0] ** 2).sum(axis=(1, 2)) * config.duration / steps,
        "apart": (_rms(us - us[:, :1]) / _rms(us[:, :1])).max(axis=1),
        "ok": np.asarray(found.status.ok).reshape(shape).mean(axis=1),
        "cost": np.asarray(cost).reshape(shape)[:, 0],
    }


def figure(result: Result) -> Figure:
    """Draw torques without effort and what becomes of them over the noise, and iterations."""
    data = result.data
    fig, axes = jc.plot.panels(2, 2, size=(7.2, 6.0))
    with jc.plot.style():
        _draw_torques(axes[0, 0], data)
        _draw_peaks(axes[0, 1], data)
        _draw_definite(axes[1, 0], data)
        recursions.draw(axes[1, 1], data)
    return fig


def _noises(data: xarray.Dataset) -> tuple[list[str], np.ndarray]:
    """Return the names of the noisy cases, and their noises [s^(1/2)]."""
    names = [str(name) for name in data.case.values if str(name).startswith("noise")]
    return names, np.array([float(name.split()[1]) for name in names])


def _draw_torques(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the elbow's torque of the first direction, each in units of its largest."""
    names, noises = _noises(data)
    shown = {names[0]: noises[0], names[2]: noises[2], names[STRONG]: noises[STRONG]}
    labels = {"effort alone": "effort alone", "neither": "neither"}
    labels |= {name: f"noise {noise:g} s$^{{1/2}}$" for name, noise in shown.items()}
    looks = zip(("k", "0.6", "C0", "C1", "C2"), ("-", "-", "-", "--", "-."), strict=True)
    edges = np.append(data.step.values, 2 * data.step.values[-1] - data.step.values[-2])
    for (name, label), (color, dash) in zip(labels.items(), looks, strict=True):
        torque = data.torque.sel(case=name, joint="elbow").values[0]
        ax.stairs(
            torque / np.abs(torque).max(), edges, baseline=None, color=color, linestyle=dash,
            linewidth=1.2, label=label,
        )  # fmt: skip
    ax.set_title("A  torques", loc="left")
    ax.set_xlabel("time [s]")
    ax.set_ylabel("elbow torque / its largest")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)


def _draw_peaks(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the largest torques over the noise, with both steps."""
    names, noises = _noises(data)
    for i, (step, one) in enumerate(data.peak.groupby("grid")):
        values = one.sel(case=names).values.reshape(len(names), -1)
        ax.loglog(
            noises, np.median(values, axis=1), "so"[i], linestyle=("--", "-")[i], color=f"C{i}",
            markersize=4, label=f"steps of {1e3 * float(step):g} ms",
        )  # fmt: skip
    alone = float(np.median(data.peak.sel(case="effort alone").values))
    ax.axhline(alone, color="k", linestyle=":", label="effort alone, no noise")
    ax.set_title("B  largest torque, median of directions", loc="left")
    ax.set_xlabel("noise [s$^{1/2}$], no effort")
    ax.set_ylabel("torque [N m]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)


def _draw_definite(ax: Axes, data: xarray.Dataset) -> None:
    """Draw over the noise how far torques from other starts, and with half the step, are off."""
    names, noises = _noises(data)
    apart = data.apart.isel(grid=0)
    kinds = {"other starts": (apart, UNIQUE), "half the step": (data.refined, SMOOTH)}
    for i, (label, (values, bound)) in enumerate(kinds.items()):
        ax.loglog(
            noises, values.sel(case=names).max("direction").values, "os"[i], linestyle="-",
            color=f"C{i}", markersize=4, label=label,
        )  # fmt: skip
        none = float(values.sel(case="neither").max())
        ax.axhline(none, color=f"C{i}", linestyle="--", linewidth=0.8, label=f"{label}, no noise")
        ax.axhline(bound, color=f"C{i}", linestyle=":", linewidth=0.8, label="bound of the claim")
    ax.set_title("C  change of the torques, largest", loc="left")
    ax.set_xlabel("noise [s$^{1/2}$], no effort")
    ax.set_ylabel("change / RMS of the torques")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)


def claims(result: Result) -> list[Claim]:
    """Judge whether noise alone makes minima, and whether the true Hessian pays."""
    data = result.data
    names, noises = _noises(data)
    return [
        _nothing(data),
        _noise_alone(data, names[0], "weak", noises[0]),
        _noise_alone(data, names[STRONG], "strong", noises[STRONG]),
        *recursions.claims(data),
    ]


def _nothing(data: xarray.Dataset) -> Claim:
    one = data.sel(case="neither").isel(grid=0)
    return Claim(
        "With neither effort nor noise ILQR has no definite minimum",
        SOURCE + ", point 1",
        f"torques from other starts more than {100 * UNIQUE:g} % apart in each direction",
        f"{_span(100 * one.apart.values)} % apart, at costs up to {one.cost.values.max():.2g}; "
        f"{one.ok.values.mean():.2f} of the starts converged, largest torques "
        f"{_span(one.peak.values)} N m",
        bool((one.apart.values > UNIQUE).all()),
    )


def _noise_alone(data: xarray.Dataset, name: str, word: str, noise: float) -> Claim:
    """Judge whether a noise alone gives minima that are unique and smooth."""
    one, effort = data.sel(case=name), data.sel(case="effort alone")
    apart, refined = one.apart.values, one.refined.values
    holds = bool((one.ok == 1).all() and (apart < UNIQUE).all() and (refined < SMOOTH).all())
    ratio = one.energy.values / effort.energy.values
    return Claim(
        f"{word.capitalize()} noise, {noise:g} s^(1/2), is an energy cost by itself: without "
        "effort ILQG converges to smooth torques",
        SOURCE + ", point 1",
        f"from all starts, to torques less than {100 * UNIQUE:g} % apart, which half the step "
        f"changes by less than {100 * SMOOTH:g} %",
        f"{one.ok.values.mean():.2f} converged; {_span(100 * apart)} % apart; half the step "
        f"changes them by {_span(100 * refined)} %; largest torques {_span(one.peak.values[0])} "
        f"N m, with half the step {_span(one.peak.values[1])}; energy {_span(ratio[0])} times "
        f"that of effort alone; expected cost {_span(one.cost.values[0])}",
        holds,
        ""
        if holds
        else "The state is known, so that feedback takes back what early noise does, at a price "
        "that falls by a constant factor with each step to the end: early torques cost nothing.",
    )


def _span(values: np.ndarray) -> str:
    return f"{values.min():.2g}-{values.max():.2g}"
