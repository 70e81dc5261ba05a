"""Solvers: one per file, all driven by `jaxctrl.solve`."""

from .._solver import (
    AbstractDirectSolver as AbstractDirectSolver,
    AbstractSolver as AbstractSolver,
    Record as Record,
)
from ._descent import AbstractDescent as AbstractDescent
from ._judging import Tolerances as Tolerances
from .boundary_value import BoundaryValue as BoundaryValue
from .conjugate_gradient import ConjugateGradient as ConjugateGradient
from .ddp import DDP as DDP
from .ilqg import ILQG as ILQG
from .ilqr import ILQR as ILQR
from .lbfgs import LBFGS as LBFGS
from .shooting import AbstractShooting as AbstractShooting
