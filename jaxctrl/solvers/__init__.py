"""Solvers: one per file, all driven by `jaxctrl.solve`."""

from ._abstract import AbstractSolver as AbstractSolver, Record as Record
from .ddp import DDP as DDP
from .ilqr import ILQR as ILQR
from .shooting import AbstractShooting as AbstractShooting, Tolerances as Tolerances
