"""Bodies to control: pendulum, cart-pole, acrobot, arms of torques or muscles, chains, vehicles.

Arms can be put into force fields (`InField`).
"""

from .._function_plant import FunctionPlant
from ._acrobot import Acrobot
from ._arm import TorqueArm
from ._car import Car
from ._cart_pole import CartPole
from ._chain import Chain
from ._field import AbstractField, Channel, ConstantForce, Curl, InField
from ._free_hand import FreeHand, PolynomialJerk
from ._muscle import (
    Muscles,
    activation_of_state,
    activation_rate,
    active_state,
    control_of_rate,
    force_length,
    force_velocity,
    passive_force,
    tension,
)
from ._muscle_arm import MUSCLES, OPTIMAL_LENGTH, MuscleArm, MusculoskeletalArm
from ._paths import AbstractPaths, CosinePaths
from ._pendulum import Pendulum
from ._quadrotor import PlanarQuadrotor
from ._rate import RateControlled
from ._skeleton import AbstractSkeleton, TwoLinkArm
from ._statics import endpoint_stiffness, isometric_torque, joint_stiffness

__all__ = [
    "MUSCLES",
    "OPTIMAL_LENGTH",
    "AbstractField",
    "AbstractPaths",
    "AbstractSkeleton",
    "Acrobot",
    "Car",
    "CartPole",
    "Chain",
    "Channel",
    "ConstantForce",
    "CosinePaths",
    "Curl",
    "FreeHand",
    "FunctionPlant",
    "InField",
    "MuscleArm",
    "Muscles",
    "MusculoskeletalArm",
    "Pendulum",
    "PlanarQuadrotor",
    "PolynomialJerk",
    "RateControlled",
    "TorqueArm",
    "TwoLinkArm",
    "activation_of_state",
    "activation_rate",
    "active_state",
    "control_of_rate",
    "endpoint_stiffness",
    "force_length",
    "force_velocity",
    "isometric_torque",
    "joint_stiffness",
    "passive_force",
    "tension",
]
