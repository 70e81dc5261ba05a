"""Differentiable optimal control of biological and robotic movement, in JAX.

A `Problem` (plant, cost, noise, bounds, time grid) goes through a solver and comes out as a
`Solution`, whose policy `simulate` runs. Submodules: `plants`, `tasks`, `problems`, `models`,
`analysis`, `linear`, `plot`.
"""

import importlib
from typing import TYPE_CHECKING

from ._version import __version__ as __version__

if TYPE_CHECKING:
    from . import (
        analysis as analysis,
        linear as linear,
        models as models,
        plants as plants,
        plot as plot,
        problems as problems,
        tasks as tasks,
    )
    from ._audit import Audit as Audit, audit as audit
    from ._augmented import (
        AbstractAugmented as AbstractAugmented,
        AbstractAugmentedHand as AbstractAugmentedHand,
        OfInner as OfInner,
    )
    from ._batch import best as best, solve_batch as solve_batch
    from ._check_gradients import (
        GradientReport as GradientReport,
        check_gradients as check_gradients,
    )
    from ._controller import (
        AbstractController as AbstractController,
        AffinePolicy as AffinePolicy,
        OpenLoop as OpenLoop,
    )
    from ._cost import FunctionCost as FunctionCost, QuadraticCost as QuadraticCost
    from ._cpu import enable_fast_cpu as enable_fast_cpu
    from ._files import load as load, save as save
    from ._function_plant import FunctionPlant as FunctionPlant
    from ._integrate import (
        RK4 as RK4,
        AbstractIntegrator as AbstractIntegrator,
        Euler as Euler,
        NextState as NextState,
    )
    from ._local_model import expand as expand
    from ._noise import (
        AbstractNoise as AbstractNoise,
        AdditiveNoise as AdditiveNoise,
        SignalDependentNoise as SignalDependentNoise,
    )
    from ._plant import (
        AbstractArm as AbstractArm,
        AbstractHand as AbstractHand,
        AbstractPlant as AbstractPlant,
    )
    from ._problem import Problem as Problem
    from ._pulses import Pulses as Pulses
    from ._simulate import Trajectory as Trajectory, simulate as simulate
    from ._solution import Solution as Solution, SolveError as SolveError
    from ._solve import solve as solve
    from ._status import Reason as Reason, Status as Status
    from ._terms import (
        AbstractCompound as AbstractCompound,
        AbstractCost as AbstractCost,
        AbstractEnd as AbstractEnd,
        AbstractEvents as AbstractEvents,
        AbstractRate as AbstractRate,
        AbstractResidual as AbstractResidual,
        At as At,
        Events as Events,
        SumCost as SumCost,
        Term as Term,
        Terms as Terms,
        parts as parts,
        terms as terms,
    )
    from ._types import LocalModel as LocalModel
    from .models._compare import compare as compare
    from .models._times import optimise_times as optimise_times
    from .solvers import (
        DDP as DDP,
        ILQR as ILQR,
        LBFGS as LBFGS,
        AbstractDirectSolver as AbstractDirectSolver,
        AbstractSolver as AbstractSolver,
        BoundaryValue as BoundaryValue,
        ConjugateGradient as ConjugateGradient,
        Record as Record,
        Tolerances as Tolerances,
    )

# Imported at first use, so that the command line answers at once, without JAX.
_WHERE = {
    "_controller": ("AbstractController", "AffinePolicy", "OpenLoop"),
    "_augmented": ("AbstractAugmented", "AbstractAugmentedHand", "OfInner"),
    "_cost": ("FunctionCost", "QuadraticCost"),
    "_cpu": ("enable_fast_cpu",),
    "_function_plant": ("FunctionPlant",),
    "_integrate": ("AbstractIntegrator", "Euler", "NextState", "RK4"),
    "_local_model": ("expand",),
    "_noise": ("AbstractNoise", "AdditiveNoise", "SignalDependentNoise"),
    "_plant": ("AbstractArm", "AbstractHand", "AbstractPlant"),
    "_problem": ("Problem",),
    "_pulses": ("Pulses",),
    "_simulate": ("Trajectory", "simulate"),
    "_status": ("Reason", "Status"),
    "_terms": (
        "AbstractCompound",
        "AbstractCost",
        "AbstractEnd",
        "AbstractEvents",
        "AbstractRate",
        "AbstractResidual",
        "At",
        "Events",
        "SumCost",
        "Term",
        "Terms",
        "parts",
        "terms",
    ),
    "_types": ("LocalModel",),
    "models._compare": ("compare",),
    "models._times": ("optimise_times",),
    "solvers": (
        "AbstractDirectSolver",
        "AbstractSolver",
        "BoundaryValue",
        "ConjugateGradient",
        "DDP",
        "ILQR",
        "LBFGS",
        "Record",
        "Tolerances",
    ),
    "_audit": ("Audit", "audit"),
    "_batch": ("best", "solve_batch"),
    "_check_gradients": ("GradientReport", "GradientRow", "check_gradients"),
    "_files": ("load", "save"),
    "_solution": ("Solution", "SolveError"),
    "_solve": ("solve",),
}
_MODULES = ("analysis", "linear", "models", "plants", "plot", "problems", "tasks")
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
