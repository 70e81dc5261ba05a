"""Theories of what a movement optimises, each applied to a task that is stated once."""

import abc
import dataclasses
import functools
import operator
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._augmented import AbstractAugmented, OfInner
from .._checks import check_array, is_concrete
from .._jacobian import dependence
from .._plant import AbstractArm, AbstractHand
from .._problem import Problem, check_x0
from .._terms import AbstractCost, At, parts, terms
from .._types import leaf
from ..plants import FreeHand, PolynomialJerk, RateControlled
from ..tasks import Effort, Marks
from ._costs import Balance, HandJerk, PolynomialJerkCost, TorqueChange


class AbstractModel(eqx.Module):
    """What a movement optimises, besides reaching its goals.

    `problem(task)` keeps a task's plant, goals and grid, and puts the model's cost in the place of
    the parts of its cost that are of the "effort" (`AbstractCost.of`); all others, your own among
    them, are goals, and stay those of the task's own plant. `start(task, x0)` gives the state from
    which to solve it, which may have more parts than x0:

        solution = jc.solve(model.problem(task), jc.DDP(), model.start(task, x0))

    This works under jit, vmap and grad; `jc.compare` does it for several models at once. Models are
    deterministic: the task's noise is left out.

    Attributes:
        name: what the model is called.
        source: who proposed it.
        smooth: whether its cost is of the torques' rate of change, so that torques that are
            controls become states (`RateControlled`).
    """

    name: eqx.AbstractClassVar[str]
    source: eqx.AbstractClassVar[str]
    smooth: eqx.AbstractClassVar[bool]

    def __check_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            known = isinstance(value, jax.Array) and is_concrete(value)
            if known and not (np.asarray(value) >= 0).all():
                raise ValueError(f"{field.name}: at least 0 is wanted, got {value}")

    @abc.abstractmethod
    def cost(self, plant: AbstractArm) -> AbstractCost:
        """Return the model's cost on an arm."""

    @abc.abstractmethod
    def problem(self, task: Problem) -> Problem:
        """Return the task as this model has it.

        Raises TypeError for a task whose plant or goals the model cannot take.
        """

    @abc.abstractmethod
    def start(self, task: Problem, x0: ArrayLike) -> Float[Array, " n"]:
        """Return the model's starting state (n,) for a state x0 (nx,) of the task's plant.

        Raises ValueError, naming x0, when it does not fit.
        """


def goals(task: Problem) -> tuple[AbstractCost, ...]:
    """Return the parts of a task's cost that are not its effort.

    Raises TypeError for what is no problem.
    """
    if not isinstance(task, Problem):
        raise TypeError(f"task: a problem such as jc.tasks.reach(...) is wanted, got {task!r}")
    return tuple(part for part in parts(task.cost) if part.of != "effort")


def marks(task: Problem) -> tuple[Marks, ...]:
    """Return what the parts of a task's cost show in plots, in order."""
    found = (getattr(part, "marks", None) for part in parts(task.cost))
    return tuple(one for one in found if one is not None)


def _replace(
    task: Problem, kept: Sequence[AbstractCost], plant: AbstractHand, cost: AbstractCost, integrator
) -> Problem:
    """Return the kept goals on the task's grid with another plant, and `cost` as its effort."""
    for goal in reversed(kept):
        cost = goal + cost
    return Problem(plant, cost, num_steps=task.num_steps, dt=task.dt, integrator=integrator)


def _arm(task: Problem, model: AbstractModel) -> AbstractArm:
    goals(task)
    if not isinstance(task.plant, AbstractArm):
        raise TypeError(
            f"task: {model.name} wants a plant with joints, got {type(task.plant).__name__}"
        )
    return task.plant


def _on_arm(model: AbstractModel, task: Problem) -> Problem:
    """Return the problem of a model that moves the task's own arm."""
    arm = _moved(model, _arm(task, model))
    kept = goals(task)
    if arm is not task.plant:
        kept = [OfInner(goal) for goal in kept]  # pyright: ignore[reportCallIssue]
    problem = _replace(task, kept, arm, model.cost(arm), task.integrator)
    if task.control_bounds is None:
        return problem
    if arm is not task.plant:
        raise ValueError(
            f"task: {model.name} makes the torques states, which have no bounds, but the task has "
            "control_bounds"
        )
    return eqx.tree_at(
        lambda p: p.control_bounds, problem, task.control_bounds, is_leaf=lambda leaf: leaf is None
    )


def _moved(model: AbstractModel, arm: AbstractArm) -> Any:
    """Return the arm, with its torques made states where the model wants their rate of change."""
    x, u = jnp.zeros((arm.nx,)), jnp.zeros((arm.nu,))
    jumps = dependence(lambda u: arm.joint_torque(x, u), u).any()
    return RateControlled(arm) if model.smooth and jumps else arm


def _start_on_arm(model: AbstractModel, task: Problem, x0: ArrayLike) -> Array:
    arm, x0 = _moved(model, _arm(task, model)), check_x0(task, x0)
    return x0 if arm is task.plant else arm.lift(x0)


class MinimumEnergy(AbstractModel):
    """Least control energy, int r |u|^2/2 dt (Li 2006, eq. 3.20; section 3.5).

    Arguments:
        weight: r, as `effort` in `jc.tasks.reach`.
    """

    weight: Float[Array, "..."] = eqx.field(converter=leaf("weight"), default=1e-4)
    name: ClassVar[str] = "minimum energy"
    source: ClassVar[str] = "Li (2006), section 3.5; Todorov & Jordan (2002)"
    smooth: ClassVar[bool] = False

    def cost(self, plant):
        """Return r |u|^2/2 per second."""
        return Effort(self.weight)

    def problem(self, task):
        """Return the task with its own plant and this effort."""
        return _on_arm(self, task)

    def start(self, task, x0):
        """Return x0 (nx,)."""
        return _start_on_arm(self, task, x0)


class MinimumTorqueChange(AbstractModel):
    """Least change of the joint torques, w/2 int |dtau/dt|^2 dt (Uno, Kawato & Suzuki 1989).

    Li (2006), eq. 2.3 and section 3.5. Torques that are controls become states, and their rates of
    change the controls; muscles are moved as they are, with a small effort, because two torques do
    not tell six muscles. At the end the torques hold the posture (`Balance`), and are free to
    change.

    Arguments:
        weight: w [s/(N m)^2]. Beside the task's w1 = 1 and w2 = 0.01, w = 1e-7 is so small that the
            goal is reached, and the path no longer depends on w (see docs/design.md).
        effort: r of the muscles' excitations; our choice.
        balance: weight of the net torque at the end [1/(N m)^2]; zero frees it, as for a hit.
    """

    weight: Float[Array, ""] = eqx.field(converter=leaf("weight"), default=1e-7)
    effort: Float[Array, ""] = eqx.field(converter=leaf("effort"), default=1e-5)
    balance: Float[Array, ""] = eqx.field(converter=leaf("balance"), default=1e-4)
    name: ClassVar[str] = "minimum torque change"
    source: ClassVar[str] = "Uno, Kawato & Suzuki (1989); Li (2006), eq. 2.3"
    smooth: ClassVar[bool] = True

    def cost(self, plant):
        """Return the cost of changing torques, of an unbalanced end, and of muscles' effort."""
        cost = TorqueChange(self.weight) + Balance(self.balance)
        return cost if isinstance(plant, AbstractAugmented) else cost + Effort(self.effort)

    def problem(self, task):
        """Return the task on the arm whose torques cannot jump."""
        return _on_arm(self, task)

    def start(self, task, x0):
        """Return x0 (nx,), with zero torques (x0, 0) where torques are states."""
        return _start_on_arm(self, task, x0)


class MinimumJerk(AbstractModel):
    """Least jerk of the hand, w/2 int |d^3 e/dt^3|^2 dt (Flash & Hogan 1985).

    Li (2006), eq. 2.1. Alone it is purely kinematic: the plant is a `FreeHand`, whatever arm the
    task has, and the hand starts and ends without acceleration. The problem is linear-quadratic for
    targets and via-points; `minimum_jerk` is its closed form. In a `WeightedSum` it is the jerk of
    the arm's hand.

    Arguments:
        weight: w [s^5/m^2], so small beside w1 = 1 that the goal is reached. With an obstacle take
            1e-8, or its k1 drives the hand far around: jerk has no natural price beside it.
        acceleration_weight: of the squared acceleration at the end [s^4/m^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=leaf("weight"), default=1e-12)
    acceleration_weight: Float[Array, ""] = eqx.field(
        converter=leaf("acceleration_weight"), default=1e-4
    )
    name: ClassVar[str] = "minimum jerk"
    source: ClassVar[str] = "Flash & Hogan (1985); Li (2006), eq. 2.1"
    smooth: ClassVar[bool] = True

    def cost(self, plant):
        """Return the cost of the jerk of an arm's hand, and of its acceleration at the end."""
        return HandJerk(self.weight, self.acceleration_weight)

    def problem(self, task):
        """Return the task of a free hand, which has no joints and so no prices of them.

        Raises TypeError for goals that are not of the hand alone, such as a posture.
        """
        kept = [goal for goal in goals(task) if goal.of != "joints"]
        for goal in kept:
            _check_of_hand(self, task, goal)
        beside = any(len(one.obstacles) for one in marks(task))
        if beside and is_concrete(self.weight) and float(np.asarray(self.weight)) < 1e-9:
            warnings.warn(
                f"MinimumJerk: beside its weight of {float(np.asarray(self.weight)):.0e} the "
                "obstacle's counts so much that the hand goes far around; try MinimumJerk(1e-8)",
                stacklevel=2,
            )
        cost = PolynomialJerkCost(self.weight, self.acceleration_weight)
        return _replace(task, kept, FreeHand(), cost, PolynomialJerk())

    def start(self, task, x0):
        """Return position, velocity and no acceleration of the hand, (6,), for x0 (nx,)."""
        x0, plant = check_x0(task, x0), task.plant
        if not isinstance(plant, AbstractHand):
            raise TypeError(f"task: a plant with a hand is wanted, got {type(plant).__name__}")
        hand, velocity = plant.hand(x0), plant.hand_velocity(x0)
        return jnp.concatenate([hand, velocity, jnp.zeros_like(hand)])


def _check_of_hand(model: AbstractModel, task: Problem, goal: AbstractCost) -> None:
    """Raise TypeError for a goal that cannot be evaluated where there is a hand alone."""
    found = terms(goal)
    name = (found.rates + found.residuals + found.ends + found.events)[0].name.split(".")[0]
    if goal.of != "hand":
        raise TypeError(
            f"task: {model.name} moves the hand alone and has no {name}; a cost that asks a plant "
            'for its hand and nothing else says `of = "hand"`'
        )
    plant, zero = FreeHand(), jnp.zeros(())
    x, u = jnp.zeros((plant.nx,)), jnp.zeros((plant.nu,))
    at = At(x, u, x, zero, jnp.array(0), task.dt, zero)
    try:
        jax.eval_shape(lambda: [term.value(plant, at) for term in found.rates + found.residuals])
        jax.eval_shape(lambda: [term.value(plant, x) for term in found.ends])
        jax.eval_shape(lambda: [event.value(plant, x, at.i) for event in found.events])
    except Exception as error:
        raise TypeError(
            f'task: {name} says `of = "hand"`, but cannot be evaluated for a hand alone, without '
            f"an arm, as {model.name} has it: {error}"
        ) from error


class WeightedSum(AbstractModel):
    """Several models' costs on one arm, added with weights (Berret et al. 2011).

    Arguments:
        models: the models, whose own weights hold too; jerk is that of the arm's hand.
        weights: one factor for each, shape (m,).

    Raises ValueError when there is none, or not one weight for each, or a negative one.
    """

    models: tuple[AbstractModel, ...]
    weights: Float[Array, " m"]
    name: ClassVar[str] = "weighted sum"
    source: ClassVar[str] = "Berret, Chiovetto, Nori & Pozzo (2011)"
    smooth: ClassVar[bool] = True

    def __init__(self, models: Sequence[AbstractModel], weights: ArrayLike):
        single = isinstance(models, AbstractModel | type)
        self.models = (models,) if single else tuple(models)  # pyright: ignore
        for model in self.models:
            if not isinstance(model, AbstractModel) or isinstance(model, WeightedSum):
                raise TypeError(f"models: models such as MinimumJerk() are wanted, got {model!r}")
        if not self.models:
            raise ValueError("models: at least one is wanted, got none")
        self.weights = check_array("weights", weights, (len(self.models),), "one for each model")

    def cost(self, plant):
        """Return the sum of the models' costs, each scaled by its weight."""
        scaled = [
            eqx.tree_at(lambda m: m.weight, model, weight * model.weight).cost(plant)  # pyright: ignore
            for model, weight in zip(self.models, self.weights, strict=True)
        ]
        return functools.reduce(operator.add, scaled)

    def problem(self, task):
        """Return the task on the arm whose torques cannot jump."""
        return _on_arm(self, task)

    def start(self, task, x0):
        """Return x0 (nx,), with zero torques (x0, 0) where torques are states."""
        return _start_on_arm(self, task, x0)
