"""Solvers: one per file, all driven by `jaxctrl.solve`."""

from ._abstract import AbstractSolver as AbstractSolver, Record as Record
from .ilqr import ILQR as ILQR
from .shooting import Tolerances as Tolerances
