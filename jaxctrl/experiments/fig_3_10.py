"""Figures 3.10 and 3.11 of Li (2006): one via-point, passed at different times.

The muscle-driven arm moves 40 cm to the right in 500 ms and passes a point far from the straight
line at 150, 250 or 320 ms, which are drawn; further times in between tell how the depth of the
speed's valley goes with the height of the curvature's peak. The thesis prints no coordinates; they
are our choice.
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
    check_active_state,
    dataset,
    depths,
    draw,
    failures,
    milliseconds,
    passed,
    plan,
    profiles,
    valleys,
)
from ._result import Claim, Result

START, TARGET, POINT = np.array([[-0.2, 0.42], [0.2, 0.42], [0.0, 0.58]])
DRAWN = (0.15, 0.25, 0.32)
FURTHER = (0.2, 0.22, 0.235, 0.265, 0.28, 0.3)
FIGURES = {"torque change": "3.10", "energy": "3.11"}


@dataclass(frozen=True)
class Config(MovementConfig):
    """Settings: those of a movement, and how many `further` passing times are tried than are
    drawn, 6 at most.
    """

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
    """Plan a movement for each passing time under both models."""
    times = DRAWN + FURTHER[: config.further]
    movements = [Movement(START, TARGET, POINT, time) for time in times]
    labels = [f"{1e3 * time:.0f} ms" for time in times]
    planned = plan(config.arm, movements, config)
    data = dataset(planned, labels, movements, config)
    return Result(data, config, failures(planned, labels))


def figure(result: Result) -> Figure:
    """Draw paths and speed profiles of the thesis's three times, one row for each model."""
    return draw(result.data.isel(movement=slice(len(DRAWN))), FIGURES)


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of these figures."""
    found = []
    for model, number in FIGURES.items():
        data, source = result.data.sel(model=model), f"Li (2006), fig. {number}"
        speeds, found_valleys = profiles(result.data, model), valleys(result.data, model)
        found += [
            passed(result.data, model, source),
            _first_peak(model, source, speeds[: len(DRAWN)]),
            _order(model, source, found_valleys[: len(DRAWN)]),
            at_the_bend(
                f"The speed's valley coincides with a peak of the curvature ({model})",
                source,
                found_valleys,
            ),
            _heights(model, source, found_valleys),
            _first_part(model, source, data),
        ]
    return found


def _first_peak(model: str, source: str, speeds: list[jc.analysis.SpeedProfile]) -> Claim:
    first = [float(profile.peak_speeds[0]) for profile in speeds]
    return Claim(
        f"The earliest passing has the highest first peak ({model})",
        source,
        "150 ms higher than 250 and 320 ms",
        "first peaks " + ", ".join(f"{speed:.2f}" for speed in first) + " m/s",
        first[0] == max(first),
        "" if first[0] == max(first) else "the first peak is not always the one before the point",
    )


ORDER = {
    False: "without a second peak there is no valley to order",
    True: "passed early, the hand swings beyond the target, and the valley is where it turns back",
}
"""Why valleys are not ordered, by whether each movement has one."""


def _order(model: str, source: str, found: list[Valley]) -> Claim:
    times = [valley.time for valley in found]
    ordered = bool(np.all(np.diff(times) > 0))
    return Claim(
        f"The later the passing, the later the speed's valley ({model})",
        source,
        "ordered as 150, 250 and 320 ms",
        "valleys at " + ", ".join(milliseconds(time) for time in times) + f"; {depths(found)}",
        ordered,
        "" if ordered else ORDER[bool(np.isfinite(times).all())],
    )


def _heights(model: str, source: str, found: list[Valley]) -> Claim:
    """Judge whether high peaks of the curvature and deep valleys go together."""
    pairs = [(v.height, v.depth) for v in found if np.isfinite(v.height)]
    correlation = float(np.corrcoef(np.transpose(pairs))[0, 1]) if len(pairs) > 2 else np.nan
    return Claim(
        f"The higher the curvature's peak, the deeper the valley ({model})",
        source,
        "positive correlation",
        f"r = {correlation:.2f} over the {len(pairs)} passing times with a valley",
        correlation > 0.5,
        "" if correlation > 0.5 else "too few valleys, or no such relation",
    )


def _first_part(model: str, source: str, data: xarray.Dataset) -> Claim:
    """Judge whether a quick first part is the straighter one."""
    bends = []
    for i, passing in enumerate(DRAWN):
        path = data.hand.values[i][data.time.values <= passing + 1e-9]
        chord = np.linalg.norm(path[-1] - path[0])
        bends.append(abs(float(jc.analysis.deviation(path))) / chord)
    return Claim(
        f"The earliest passing has the straightest first part ({model})",
        source,
        "150 ms less curved up to the via-point than 250 and 320 ms",
        "deviation over distance " + ", ".join(f"{100 * bend:.1f} %" for bend in bends),
        bends[0] == min(bends),
        ""
        if bends[0] == min(bends)
        else "the first part's bend is that of the model's own optimum",
    )
