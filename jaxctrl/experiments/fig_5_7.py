"""Figure 5.7 of Li (2006): reaches of the six-muscle arm by ILQG, its state fully observed.

10 cm in 16 directions under motor noise of 0.02 s^(1/2), a fifth of each excitation over 10 ms.
A muscle works twice in a reach: it starts movements along its own pull and stops those against
it. Its mean excitation over a whole movement therefore has two lobes, and what a cosine explains
of it is little; the first half of the movement, in which the hand is sped up, shows its direction.
Tuning is compared in each. Start, noise and weights are ours.
"""

from dataclasses import dataclass

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _chapter_5 as shared
from ._result import Claim, Result, named

PAIRS = {"elbow": ("EF", "EX"), "shoulder": ("SF", "SX"), "biarticular": ("BF", "BX")}
"""Flexors and extensors that oppose each other."""
MUSCLES = tuple(muscle for pair in zip(*PAIRS.values(), strict=True) for muscle in pair)
WINDOWS = {"whole": (0.0, 1.0), "first half": (0.0, 0.5), "second half": (0.5, 1.0)}
"""Parts of the movement over which excitations are averaged, in units of its duration."""


@dataclass(frozen=True)
class Config(shared.Reaches):
    """Settings: those of the reaches."""

    directions: int = 16

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with half the directions."""
        return cls(directions=8)


def run(config: Config) -> Result:
    """Plan in every direction, and fit a cosine to each muscle's mean excitation."""
    arm = jc.plants.MuscleArm()
    found = jc.solve_batch(config.problems(arm), jc.ILQG(), arm.at_rest(*shared.START))
    us = np.asarray(found.us)
    starts = np.arange(config.num_steps) / config.num_steps
    means = np.stack([us[:, (starts >= a) & (starts < b)].mean(1) for a, b in WINDOWS.values()])
    towards, explained = _tuning(shared.angles(config.directions), means)
    tuned = ("window", "muscle")
    data = config.planned(arm, found) | {
        "excitation": (("direction", "step", "muscle"), us, named("planned excitation", "1")),
        "activation": (
            ("direction", "time", "muscle"),
            found.xs[..., 4:],
            named("planned activation", "1"),
        ),
        "mean_excitation": (
            ("window", "direction", "muscle"),
            means,
            named("mean excitation over a part of the movement", "1"),
        ),
        "preferred": (
            tuned,
            np.degrees(towards),
            named("direction of the fitted cosine", "degree"),
        ),
        "explained": (tuned, explained, named("R^2 of the fitted cosine", "1")),
    }
    coords = config.coordinates("step")
    coords["muscle"] = ("muscle", list(jc.plants.MUSCLES), {"long_name": "muscle"})
    coords["window"] = ("window", list(WINDOWS), {"long_name": "part of the movement"})
    failure = "" if bool(found.status.ok.all()) else found.status.message
    return Result(xarray.Dataset(data, coords=coords), config, failure)


def _tuning(angles: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a + b cos(angle - c) over directions; return c [rad] and R^2, each (window, muscle).

    Arguments: angles (n,) and means (window, n, muscle).
    """
    basis = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], axis=1)
    weights = np.linalg.pinv(basis) @ means
    around = means - means.mean(axis=1, keepdims=True)
    left = means - basis @ weights
    explained = 1 - (left**2).sum(axis=1) / (around**2).sum(axis=1)
    return np.arctan2(weights[:, 2], weights[:, 1]), explained


def figure(result: Result) -> Figure:
    """Draw paths, speeds and activation maps of each muscle, and the tuning of the pairs."""
    data = result.data
    fig, axes = jc.plot.panels(3, 4, size=(10.5, 7.4))
    for ax in axes[:2, 0]:
        shared.colour_directions(ax, data)
    labels = [f"{angle:g}°" for angle in data.direction.values]
    jc.plot.hand_paths(list(data.hand.values), data.target.values, labels=labels, ax=axes[0, 0])
    jc.plot.speed_profiles(data.time, list(data.speed.values), labels=labels, ax=axes[1, 0])
    for ax in axes[:2, 0]:
        ax.get_legend().remove()
    with jc.plot.style():
        _draw_maps(fig, axes[:2, 1:], data)
        for ax, pair in zip(axes[2, 1:], PAIRS, strict=True):
            _draw_tuning(ax, data, pair)
        for ax in axes[2, 2:]:
            ax.set_ylabel("")
        _draw_explained(axes[2, 0], data)
    return fig


def _draw_maps(fig: Figure, axes: np.ndarray, data: xarray.Dataset) -> None:
    """Draw the activation of each muscle over direction and time, in one scale."""
    scale = Normalize(0.0, float(data.activation.max()))
    for ax, muscle in zip(axes.flat, MUSCLES, strict=True):
        ax.pcolormesh(
            data.time.values,
            data.direction.values,
            data.activation.sel(muscle=muscle).values,
            norm=scale,
            cmap="viridis",
            shading="nearest",
            rasterized=True,
        )
        ax.set_yticks([0, 90, 180, 270])
        ax.set_title(muscle, loc="left")
    for ax in axes[:, 0]:
        ax.set_ylabel("direction [°]")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    colours = ScalarMappable(scale, "viridis")
    fig.colorbar(colours, ax=list(axes.flat), label="activation [–]", aspect=30)


def _draw_tuning(ax: Axes, data: xarray.Dataset, pair: str) -> None:
    """Draw the mean excitation of two opposed muscles in either half, over direction."""
    turn = np.append(data.direction.values, 360.0)
    for i, muscle in enumerate(PAIRS[pair]):
        values = data.mean_excitation.sel(muscle=muscle)
        for window, dash in (("first half", "-"), ("second half", ":")):
            one = values.sel(window=window).values
            label = muscle if window == "first half" else None
            ax.plot(
                turn, np.append(one, one[0]), dash, color=f"C{i}", marker="os"[i], markersize=3,
                label=label, clip_on=False,
            )  # fmt: skip
    ax.plot([], [], ":", color="0.4", label="2nd half")
    shared.on_compass(ax)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("mean excitation [–]")
    ax.set_title(pair, loc="left")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.3), ncols=3, columnspacing=1.0)


def _draw_explained(ax: Axes, data: xarray.Dataset) -> None:
    """Draw how much of each muscle's tuning a cosine explains."""
    for i, window in enumerate(WINDOWS):
        values = data.explained.sel(window=window, muscle=list(MUSCLES)).values
        ax.plot(values, "os^"[i], color=f"C{i + 2}", markersize=5, label=window)
    ax.set_xticks(range(len(MUSCLES)), MUSCLES)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("muscle")
    ax.set_ylabel("R² of a cosine [–]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.3), ncols=3, handletextpad=0.1,
              columnspacing=0.8)  # fmt: skip


SOURCE = "Li (2006), fig. 5.7"
TWO_LOBES = (
    "a muscle both starts and stops movements: of its two lobes the larger one gives the peak, by "
    "little, and a cosine explains next to nothing"
)


def claims(result: Result) -> list[Claim]:
    """Judge excitations, end points and the tuning of opposed muscles."""
    data = result.data
    errors = shared.end_errors(data)
    named_values = (("excitations", data.excitation), ("activations", data.activation))
    ranges = [(word, float(a.min()), float(a.max())) for word, a in named_values]
    return [
        Claim(
            "Excitations and activations lie between 0 and 1",
            SOURCE,
            "0 to 1",
            ", ".join(f"{word} {low:.2g} to {high:.2g}" for word, low, high in ranges),
            all(low >= 0 and high <= 1 for _, low, high in ranges),
        ),
        Claim(
            "The hand ends on its target in all directions",
            SOURCE,
            "within 5 mm",
            f"largest error {1e3 * errors.max():.3f} mm",
            bool((errors < shared.NEAR).all()),
        ),
        _opposed(data, "first half", "start"),
        _opposed(data, "second half", "stop"),
        _opposed(data, "whole", "make"),
        _reversed(data),
    ]


def _peaks(data: xarray.Dataset, window: str) -> dict[str, float]:
    """Return the direction of each muscle's largest mean excitation [degree]."""
    means = data.mean_excitation.sel(window=window)
    return {m: float(data.direction[int(means.sel(muscle=m).values.argmax())]) for m in MUSCLES}


def _apart(a: float, b: float) -> float:
    """Return the angle between two directions, 0 to 180 [degree]."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def _opposed(data: xarray.Dataset, window: str, verb: str) -> Claim:
    """Judge whether the muscles of a pair are excited most in opposed directions."""
    peaks, one = _peaks(data, window), data.sel(window=window)
    fitted = dict(zip(one.muscle.values, one.preferred.values, strict=True))
    gaps = {f"{a}-{b}": _apart(peaks[a], peaks[b]) for a, b in PAIRS.values()}
    fits = {f"{a}-{b}": _apart(fitted[a], fitted[b]) for a, b in PAIRS.values()}
    listed = ", ".join(f"{pair} {gaps[pair]:g} (cosines {fits[pair]:.0f})" for pair in gaps)
    squares = ", ".join(f"{m} {float(one.explained.sel(muscle=m)):.2f}" for m in MUSCLES)
    holds = all(gap > 90 for gap in gaps.values())
    part = "over the whole movement" if window == "whole" else f"over its {window}"
    note = "" if holds else "the larger lobe of each muscle decides"
    return Claim(
        f"Opposed muscles {verb} movements of opposed directions, {part}",
        SOURCE,
        "peaks of the mean excitation more than 90 degrees apart, in each pair",
        f"{listed} degrees; R^2 of the cosines: {squares}",
        holds,
        TWO_LOBES if window == "whole" else note,
    )


def _reversed(data: xarray.Dataset) -> Claim:
    """Judge whether each muscle stops the movements that run against those it starts."""
    first, second = _peaks(data, "first half"), _peaks(data, "second half")
    gaps = {m: _apart(first[m], second[m]) for m in MUSCLES}
    holds = all(gap > 90 for gap in gaps.values())
    return Claim(
        "Each muscle stops movements opposed to those that it starts",
        SOURCE,
        "peaks of the mean excitation of both halves more than 90 degrees apart, in each muscle",
        ", ".join(f"{m} {gap:g}" for m, gap in gaps.items()) + " degrees",
        holds,
        "" if holds else "the larger lobe of each half decides",
    )
