# The public names of jaxctrl, each listed once: type checkers read this file, and jaxctrl itself
# when a name is first asked for. To add a name, add it here.

from . import (
    analysis as analysis,
    experiments as experiments,
    linear as linear,
    models as models,
    plants as plants,
    plot as plot,
    problems as problems,
    stopwatch as stopwatch,
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
    GradientRow as GradientRow,
    check_gradients as check_gradients,
)
from ._controller import (
    AbstractController as AbstractController,
    AffinePolicy as AffinePolicy,
    OpenLoop as OpenLoop,
)
from ._cost import FunctionCost as FunctionCost, QuadraticCost as QuadraticCost
from ._cpu import enable_fast_cpu as enable_fast_cpu
from ._estimator import (
    AbstractEstimator as AbstractEstimator,
    LinearFilter as LinearFilter,
    OutputFeedback as OutputFeedback,
)
from ._evaluate import Evaluation as Evaluation, evaluate as evaluate
from ._expand import expand as expand
from ._files import load as load, save as save
from ._function_plant import FunctionPlant as FunctionPlant
from ._integrate import (
    RK4 as RK4,
    AbstractIntegrator as AbstractIntegrator,
    Euler as Euler,
    NextState as NextState,
)
from ._noise import (
    AbstractNoise as AbstractNoise,
    AdditiveNoise as AdditiveNoise,
    FunctionNoise as FunctionNoise,
    SignalDependentNoise as SignalDependentNoise,
    StateDependentNoise as StateDependentNoise,
    SumNoise as SumNoise,
)
from ._plant import (
    AbstractArm as AbstractArm,
    AbstractHand as AbstractHand,
    AbstractPlant as AbstractPlant,
)
from ._prediction import Prediction as Prediction
from ._problem import Problem as Problem
from ._pulses import Pulses as Pulses
from ._sensor import (
    AbstractSensor as AbstractSensor,
    DelayedSensor as DelayedSensor,
    FunctionSensor as FunctionSensor,
    HandSensor as HandSensor,
    JointSensor as JointSensor,
    LinearSensor as LinearSensor,
    SumSensor as SumSensor,
)
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
from ._types import LocalModel as LocalModel, array_leaf as array_leaf
from ._version import __version__ as __version__
from .models._compare import compare as compare
from .models._times import optimise_times as optimise_times
from .solvers import (
    DDP as DDP,
    ILQG as ILQG,
    ILQR as ILQR,
    LBFGS as LBFGS,
    AbstractDirectSolver as AbstractDirectSolver,
    AbstractShooting as AbstractShooting,
    AbstractSolver as AbstractSolver,
    BoundaryValue as BoundaryValue,
    ConjugateGradient as ConjugateGradient,
    Record as Record,
    Tolerances as Tolerances,
)
