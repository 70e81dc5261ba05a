"""Differentiable optimal control of biological and robotic movement, in JAX.

A `Problem` (plant, cost, noise, bounds, time grid) goes through a solver and comes out as a
`Solution`, whose policy `simulate` runs. Submodules: `plants`, `tasks`, `linear`, `plot`.
"""

import importlib
from typing import TYPE_CHECKING

from ._version import __version__ as __version__

if TYPE_CHECKING:
    from . import linear as linear
    from . import plants as plants
    from . import plot as plot
    from . import tasks as tasks
    from ._controller import (
        AbstractController as AbstractController,
    )
    from ._controller import (
        AffinePolicy as AffinePolicy,
    )
    from ._controller import (
        OpenLoop as OpenLoop,
    )
    from ._cost import (
        AbstractCost as AbstractCost,
    )
    from ._cost import (
        Events as Events,
    )
    from ._cost import (
        FunctionCost as FunctionCost,
    )
    from ._cost import (
        QuadraticCost as QuadraticCost,
    )
    from ._cost import (
        SumCost as SumCost,
    )
    from ._integrate import (
        RK4 as RK4,
    )
    from ._integrate import (
        AbstractIntegrator as AbstractIntegrator,
    )
    from ._integrate import (
        Euler as Euler,
    )
    from ._integrate import (
        NextState as NextState,
    )
    from ._local_model import expand as expand
    from ._noise import (
        AbstractNoise as AbstractNoise,
    )
    from ._noise import (
        AdditiveNoise as AdditiveNoise,
    )
    from ._noise import (
        SignalDependentNoise as SignalDependentNoise,
    )
    from ._plant import (
        AbstractArm as AbstractArm,
    )
    from ._plant import (
        AbstractPlant as AbstractPlant,
    )
    from ._plant import (
        FunctionPlant as FunctionPlant,
    )
    from ._problem import Problem as Problem
    from ._simulate import Trajectory as Trajectory
    from ._simulate import simulate as simulate
    from ._status import Reason as Reason
    from ._status import Status as Status
    from ._types import LocalModel as LocalModel
    from .solvers import (
        ILQR as ILQR,
    )
    from .solvers import (
        AbstractSolver as AbstractSolver,
    )
    from .solvers import (
        Record as Record,
    )
    from .solvers import (
        Tolerances as Tolerances,
    )
    from .solvers._solution import Solution as Solution
    from .solvers._solution import SolveError as SolveError
    from .solvers._solve import solve as solve

# Imported at first use, so that the command line answers at once, without JAX.
_WHERE = {
    "_controller": ("AbstractController", "AffinePolicy", "OpenLoop"),
    "_cost": ("AbstractCost", "Events", "FunctionCost", "QuadraticCost", "SumCost"),
    "_integrate": ("AbstractIntegrator", "Euler", "NextState", "RK4"),
    "_local_model": ("expand",),
    "_noise": ("AbstractNoise", "AdditiveNoise", "SignalDependentNoise"),
    "_plant": ("AbstractArm", "AbstractPlant", "FunctionPlant"),
    "_problem": ("Problem",),
    "_simulate": ("Trajectory", "simulate"),
    "_status": ("Reason", "Status"),
    "_types": ("LocalModel",),
    "solvers": ("AbstractSolver", "ILQR", "Record", "Tolerances"),
    "solvers._solution": ("Solution", "SolveError"),
    "solvers._solve": ("solve",),
}
_MODULES = ("linear", "plants", "plot", "tasks")
_LAZY = {name: module for module, names in _WHERE.items() for name in names}

__all__ = ["__version__", *sorted(_LAZY), *_MODULES]  # pyright: ignore


def __getattr__(name: str):
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _LAZY:
        value = getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return __all__
