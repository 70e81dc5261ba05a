"""Bodies to control: pendulum, two-link arms moved by torques or muscles, chains; force fields."""

from .._plant import FunctionPlant
from ._arm import TorqueArm, TwoLinkArm
from ._chain import Chain
from ._field import AbstractField, Channel, ConstantForce, Curl, InField
from ._free_hand import FreeHand, PolynomialJerk
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
from ._rate import RateControlled

__all__ = [
    "MUSCLES",
    "AbstractField",
    "Chain",
    "Channel",
    "ConstantForce",
    "Curl",
    "FreeHand",
    "FunctionPlant",
    "InField",
    "MuscleArm",
    "Pendulum",
    "PolynomialJerk",
    "RateControlled",
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
