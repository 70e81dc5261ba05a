"""Figures 3.8 and 3.9 of Li (2006): via-points near to the straight line, and far from it.

The muscle-driven arm moves 40 cm to the right in 500 ms, passing a point at 250 ms; further points
than the drawn ones tell at which distance the second peak of the speed appears. The thesis prints
no coordinates; they are our choice.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

import jaxctrl as jc

from ._planned import (
    Movement,
    MovementConfig,
    Valley,
    check_active_state,
    dataset,
    depths,
    draw,
    failures,
    least_jerk,
    passed,
    plan,
    profiles,
    valleys,
)
from ._result import Claim, Result, named

START, TARGET = np.array([-0.2, 0.42]), np.array([0.2, 0.42])
DRAWN = (0.45, 0.52, 0.58)
FURTHER = (0.48, 0.5, 0.54, 0.56, 0.6)
FIGURES = {"torque change": "3.8", "energy": "3.9"}


@dataclass(frozen=True)
class Config(MovementConfig):
    """Settings: those of a movement, the time [s] at which the via-point is passed, and how many
    `further` via-points are tried than are drawn, 5 at most.
    """

    passing: float = 0.25
    further: int = len(FURTHER)

    @classmethod
    def quick(cls) -> "Config":
        """Return settings for fewer and slower movements, coarser and without random starts."""
        return cls(duration=0.6, num_steps=25, restarts=0, further=1)

    def __post_init__(self):
        check_active_state(self.active_state)
        if not 0 <= self.further <= len(FURTHER):
            raise ValueError(f"further: 0 to {len(FURTHER)} are wanted, got {self.further}")


def run(config: Config) -> Result:
    """Plan the movements under both models."""
    heights = DRAWN + FURTHER[: config.further]
    movements = [Movement(START, TARGET, np.array([0.0, y]), config.passing) for y in heights]
    labels = ["P0", "P1", "P2", *(f"y = {y} m" for y in heights[len(DRAWN) :])]
    planned = plan(config.arm, movements, config)
    data = dataset(planned, labels, movements, config)
    jerk = [least_jerk(movement, data.time.values).velocity for movement in movements]
    speed = np.linalg.norm(jerk, axis=-1)
    data["jerk"] = (("movement", "time"), speed, named("hand speed of least jerk", "m/s"))
    return Result(data, config, failures(planned, labels))


def figure(result: Result) -> Figure:
    """Draw paths and speed profiles, one row for each model."""
    return draw(result.data.isel(movement=slice(len(DRAWN))), FIGURES)


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of these figures."""
    found, ts = [], result.data.time.values
    jerk = [jc.analysis.speed_peaks(ts, speed) for speed in result.data.jerk.values]
    for model, number in FIGURES.items():
        source, speeds = f"Li (2006), fig. {number}", profiles(result.data, model)
        found += [
            passed(result.data, model, source),
            _counts(model, source, speeds, jerk, valleys(result.data, model)),
            *_with_distance(model, source, speeds, jerk, result.data.point.values[:, 1] - START[1]),
        ]
    return found


Profiles = list[jc.analysis.SpeedProfile]


def _counts(
    model: str, source: str, speeds: Profiles, jerk: Profiles, found: list[Valley]
) -> Claim:
    counts, straight = (
        [len(profile.peak_times) for profile in those[: len(DRAWN)]] for those in (speeds, jerk)
    )
    return Claim(
        f"Near the straight line the speed has one peak, far from it two ({model})",
        source,
        "1 peak through P0, 2 through P1 and P2",
        f"{counts[0]}, {counts[1]} and {counts[2]}; least jerk has {straight[0]}, {straight[1]} "
        f"and {straight[2]}; {depths(found[: len(DRAWN)])}",
        counts == [1, 2, 2],
        "" if counts == [1, 2, 2] else "P1, 10 cm aside, is not yet far for any of the models",
    )


def _with_distance(
    model: str, source: str, speeds: Profiles, jerk: Profiles, aside: np.ndarray
) -> list[Claim]:
    """Judge how the second peak appears and the valley deepens with the distance."""
    order = np.argsort(aside)
    double, jerky = (
        np.array([len(those[i].peak_times) > 1 for i in order]) for those in (speeds, jerk)
    )
    depths = np.array([max(speeds[i].valley_depth, default=0.0) for i in order])
    far = aside[order]

    def onset(found: np.ndarray) -> str:
        return f"{100 * far[found].min():.0f} cm" if found.any() else "none"

    once = bool(np.all(np.diff(double.astype(int)) >= 0) and double.any() and not double[0])
    return [
        Claim(
            f"One peak up to some distance of the via-point, two beyond ({model})",
            source,
            "one change from 1 to 2 peaks, between 3 and 18 cm",
            f"two from {onset(double)} on (least jerk from {onset(jerky)})",
            once,
            "" if once else "peaks come and go with the distance: several optima compete",
        ),
        Claim(
            f"The valley deepens with the via-point's distance ({model})",
            source,
            "the further, the deeper",
            "depths "
            + ", ".join(f"{100 * d:.0f} %" for d in depths)
            + " at "
            + ", ".join(f"{100 * d:.0f}" for d in far)
            + " cm",
            bool(np.all(np.diff(depths) >= -0.005) and depths[-1] > depths[0]),
            "as a share of the lower neighbouring peak",
        ),
    ]
