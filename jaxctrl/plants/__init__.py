"""Bodies to control: a pendulum, two-link arms moved by torques or muscles, and planar chains."""

from .._plant import FunctionPlant
from ._arm import TorqueArm, TwoLinkArm
from ._chain import Chain
from ._muscle import (
    activation_rate,
    active_state,
    control_of_rate,
    force_length,
    force_velocity,
    passive_force,
    tension,
)
from ._muscle_arm import MUSCLES, MuscleArm
from ._pendulum import Pendulum

__all__ = [
    "MUSCLES",
    "Chain",
    "FunctionPlant",
    "MuscleArm",
    "Pendulum",
    "TorqueArm",
    "TwoLinkArm",
    "activation_rate",
    "active_state",
    "control_of_rate",
    "force_length",
    "force_velocity",
    "passive_force",
    "tension",
]
