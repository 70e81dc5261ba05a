"""Figures 3.4 and 3.5 of Li (2006): free movements under minimum torque change and energy.

Ten movements of the muscle-driven arm between five targets, of 500 ms. The thesis prints no
coordinates; the targets are our choice, within the figures' axes. Minimum jerk, whose paths are
straight, is drawn for comparison; the same movements of the torque-driven arm tell which findings
are the muscles'.
"""

from dataclasses import dataclass

import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._planned import (
    Movement,
    MovementConfig,
    dataset,
    failures,
    least_jerk,
    plan,
    profiles,
    slightly_curved,
)
from ._result import Claim, Result, named

TARGETS = np.array([[-0.01, 0.44], [-0.055, 0.385], [0.0, 0.31], [0.06, 0.38], [0.045, 0.43]])
PAIRS = [(1, 3), (4, 2), (4, 3), (5, 2), (5, 3)]
FROM_TO = [pair for i, j in PAIRS for pair in ((i, j), (j, i))]
FIGURES = {"torque change": "3.4", "energy": "3.5"}


@dataclass(frozen=True)
class Config(MovementConfig):
    """Settings: those of every planned movement."""

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with fewer time steps and without random starts."""
        return cls(num_steps=25, restarts=0)


def run(config: Config) -> Result:
    """Plan all movements of both arms; those of least jerk in closed form."""
    movements = [Movement(TARGETS[i - 1], TARGETS[j - 1]) for i, j in FROM_TO]
    labels = [f"T{i} to T{j}" for i, j in FROM_TO]
    muscle, torque = (plan(arm, movements, config) for arm in (config.arm, jc.plants.TorqueArm()))
    data = dataset(muscle, labels, movements, config)
    ts = data.time.values
    jerk = [np.asarray(least_jerk(one, ts).position) for one in movements]
    data["jerk"] = (("movement", "time", "axis"), np.stack(jerk), named("least jerk", "m"))
    data["distance"] = (
        ("arm", "between", "movement"),
        np.stack([_distances(found, jerk) for found in (muscle, torque)]),
        named("distance between the paths of two models", "m"),
    )
    data = data.assign_coords(
        arm=("arm", ["muscle", "torque"], {"long_name": "arm"}),
        between=("between", ["models", "torque change", "energy"], {"long_name": "between"}),
    )
    unsolved = [text for text in (failures(muscle, labels), failures(torque, labels)) if text]
    return Result(data, config, "; ".join(unsolved))


def _distances(found, jerk) -> np.ndarray:
    """Return distances [m], (3, M): between both models, and of each from least jerk."""
    change, energy = ([one.hand for one in found[model]] for model in FIGURES)
    pairs = (zip(change, energy, strict=True), zip(change, jerk, strict=True))
    return np.array(
        [[jc.analysis.path_distance(a, b) for a, b in pair] for pair in pairs]
        + [[jc.analysis.path_distance(a, b) for a, b in zip(energy, jerk, strict=True)]]
    )


def figure(result: Result) -> Figure:
    """Draw paths and speed profiles, one row for each model."""
    data = result.data
    fig, axes = jc.plot.panels(2, 2, size=(7.5, 6.4))
    labels = [str(label) for label in data.movement.values]
    for row, (model, number) in zip(axes, FIGURES.items(), strict=True):
        jc.plot.hand_paths(
            list(data.hand.sel(model=model).values), TARGETS, labels=labels, starts=[], ax=row[0]
        )
        for name, place in zip("12345", TARGETS, strict=True):
            out = place - TARGETS.mean(axis=0)  # away from the movements
            aside = 11 * out / np.linalg.norm(out)
            row[0].annotate(
                f"T{name}",
                100 * place,
                xytext=tuple(aside),
                textcoords="offset points",
                ha="center",
                va="center",
                fontsize=7,
            )
        jc.plot.speed_profiles(
            data.time, list(data.speed.sel(model=model).values), labels=labels, ax=row[1]
        )
        row[1].get_legend().remove()
        with jc.plot.style():
            row[0].set_title(f"{number}  minimum {model}", loc="left")
    return fig


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of these figures."""
    data, found = result.data, []
    length = np.linalg.norm(data.jerk.values[:, -1] - data.jerk.values[:, 0], axis=1)
    for model, number in FIGURES.items():
        source = f"Li (2006), fig. {number}"
        single = [len(profile.peak_times) == 1 for profile in profiles(data, model)]
        hand, speed = data.hand.sel(model=model).values, data.speed.sel(model=model).values
        bend = np.abs(jc.analysis.deviation(hand)) / length
        slight, curved = slightly_curved(bend)
        spread = data.spread.sel(model=model).values
        found += [
            Claim(
                f"Speed profiles are single-peaked under minimum {model}",
                source,
                "one peak in each of 10 movements",
                f"one peak in {sum(single)} of {len(single)}",
                all(single),
                "" if all(single) else MUSCLES,
            ),
            Claim(
                f"Paths are slightly curved under minimum {model}",
                source,
                "deviation from the straight line over its length: median above 0.5 %, 95 % below "
                "15 % (our reading)",
                curved,
                slight,
                "" if slight else MUSCLES,
            ),
            Claim(
                f"Peak speeds under minimum {model} are those of the figure's axis",
                source,
                "up to about 0.55 m/s",
                f"{speed.max(axis=1).min():.2f} to {speed.max():.2f} m/s; the starts' costs differ "
                f"by up to a factor {spread.max():.2f}",
                bool(speed.max() < 0.6),
            ),
        ]
    return found + [_alike(data, arm) for arm in ("muscle", "torque")]


MUSCLES = (
    "where force grows faster than in proportion to the activation, least squared excitation bends "
    "the path to let a muscle pull alone, and pulls in bursts: docs/design.md compares the three "
    "active states"
)


def _alike(data: xarray.Dataset, arm: str) -> Claim:
    """Judge how far the two models' paths are apart, as a share of the movement's length."""
    length = np.linalg.norm(data.jerk.values[:, -1] - data.jerk.values[:, 0], axis=1)
    shares = 100 * data.distance.sel(arm=arm).values / length
    between, change, energy = (float(np.sqrt(np.mean(share**2))) for share in shares)
    return Claim(
        f"Both models' paths of the {arm}-driven arm are alike",
        "Li (2006), section 3.5",
        "distance between them at most 3 % of the length (root mean square; our reading)",
        f"{between:.1f} % apart, at most {shares[0].max():.1f} %; from least jerk {change:.1f} % "
        f"(torque change) and {energy:.1f} % (energy)",
        between <= 3.0,
        "" if between <= 3.0 else MUSCLES,
    )
