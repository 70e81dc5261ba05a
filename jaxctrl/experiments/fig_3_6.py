"""Figures 3.6 and 3.7 of Li (2006): through one of two mirror-image via-points.

The muscle-driven arm moves 40 cm to the right in 500 ms and passes, half-way in time, a point on
either side of the straight line. The thesis prints no coordinates; they are our choice.
"""

from dataclasses import dataclass

import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._planned import (
    Movement,
    MovementConfig,
    Valley,
    at_the_bend,
    dataset,
    depths,
    draw,
    failures,
    passed,
    plan,
    profiles,
    valleys,
)
from ._result import Claim, Result

START, TARGET = np.array([-0.2, 0.4]), np.array([0.2, 0.4])
POINTS = np.array([[0.0, 0.55], [0.0, 0.25]])
FIGURES = {"torque change": "3.6", "energy": "3.7"}


@dataclass(frozen=True)
class Config(MovementConfig):
    """Settings: those of a movement, and the time [s] at which the via-point is passed."""

    passing: float = 0.25

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with fewer time steps and without random starts."""
        return cls(num_steps=25, restarts=0)


def run(config: Config) -> Result:
    """Plan both movements under both models."""
    movements = [Movement(START, TARGET, point, config.passing) for point in POINTS]
    planned, labels = plan(config.arm, movements, config), ["P1", "P2"]
    data = dataset(planned, labels, movements, config)
    return Result(data, config, failures(planned, labels))


def figure(result: Result) -> Figure:
    """Draw paths and speed profiles, one row for each model."""
    return draw(result.data, FIGURES)


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of these figures."""
    found = []
    for model, number in FIGURES.items():
        data, source = result.data.sel(model=model), f"Li (2006), fig. {number}"
        speeds, found_valleys = profiles(result.data, model), valleys(result.data, model)
        found.append(passed(result.data, model, source))
        found.append(_two_peaks(model, source, speeds, found_valleys))
        statement = f"The speed's valley is where the path bends most, under minimum {model}"
        found.append(at_the_bend(statement, source, found_valleys))
        found.append(_sides(model, source, data))
        mirrored = data.hand.values[1] * [1, -1] + [0, 2 * START[1]]
        apart = 1e3 * jc.analysis.path_distance(data.hand.values[0], mirrored)
        found.append(
            Claim(
                f"The two paths are no mirror images under minimum {model}",
                source,
                "not symmetric: more than 1 mm (our reading)",
                f"P1's path and the mirror image of P2's are {apart:.1f} mm apart",
                bool(apart > 1),
            )
        )
    return found


NOT_FAR = (
    "15 cm aside of a line of 40 cm is not far enough for this model; the speed of least jerk dips "
    "by no more than 4 % there. See fig-3.8 for the distance at which the second peak appears"
)


def _two_peaks(
    model: str, source: str, speeds: list[jc.analysis.SpeedProfile], found: list[Valley]
) -> Claim:
    counts = [len(profile.peak_times) for profile in speeds]
    return Claim(
        f"The speed has two peaks under minimum {model}",
        source,
        "2 peaks through P1, 2 through P2",
        f"{counts[0]} and {counts[1]}; {depths(found)}",
        counts == [2, 2],
        "" if counts == [2, 2] else NOT_FAR,
    )


def _sides(model: str, source: str, data: xarray.Dataset) -> Claim:
    aside = 1e3 * np.array([float(jc.analysis.deviation(hand)) for hand in data.hand.values])
    return Claim(
        f"P1's path is convex, P2's concave, under minimum {model}",
        source,
        "P1 bulges away from the body, P2 towards it",
        f"largest deviation {aside[0]:+.0f} mm through P1, {aside[1]:+.0f} mm through P2",
        bool(aside[0] > 0 > aside[1]),
    )
