"""Figure 5.10 (A) of Li (2006): reaches of the six-muscle arm planned from 50 random control laws.

See `_random_laws` for how the laws are drawn, and what is judged.
"""

from dataclasses import dataclass

import jaxctrl as jc

from . import _random_laws as shared
from ._result import Claim, Result

AMPLITUDES = (0.1, 0.3, 1.0)
"""Largest open-loop excitation of the laws."""


@dataclass(frozen=True)
class Config(shared.Settings):
    """Settings: those of `_random_laws`."""


def run(config: Config) -> Result:
    """Plan with the six-muscle arm; arrays lead with the amplitude, the direction and the law."""
    return shared.run(jc.plants.MuscleArm(), AMPLITUDES, config)


figure = shared.figure


def claims(result: Result) -> list[Claim]:
    """Count who finds the best, and measure where planned paths end."""
    return shared.claims(result, "Li (2006), fig. 5.10 (A)")
