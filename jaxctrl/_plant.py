"""What a plant is: dynamics as a pure function, with its own bounds and nominal control."""

import abc
import dataclasses
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._types import Bounds, array_leaf, as_bounds


class _Default:
    """What an instance has unless its class says otherwise.

    The class itself has no such attribute: a dataclass would take it as the default of a subclass's
    field of that name, and refuse fields without one after it.
    """

    def __init__(self, of: Callable[[Any], Any]):
        self.of = of

    def __get__(self, instance, owner=None):
        if instance is None:
            raise AttributeError("an attribute of instances, or of subclasses")
        return self.of(instance)


def _dtype(plant) -> Any:
    """Return the widest dtype among a plant's numbers, or JAX's default."""
    numbers = [leaf for leaf in jax.tree.leaves(plant) if eqx.is_inexact_array(leaf)]
    return jnp.result_type(*numbers) if numbers else jnp.result_type(float)


class AbstractPlant(eqx.Module):
    """Dynamics of a body, as a function of state, control and time.

    A subclass states its sizes, its numbers and the dynamics:

        class Mass(jc.AbstractPlant):
            nx: ClassVar[int] = 2
            nu: ClassVar[int] = 1
            m: Array = eqx.field(converter=jc.array_leaf, default=1.0)
            control_bounds = (-1.0, 1.0)

            def __call__(self, x, u, t):
                return jnp.stack([x[1], u[0] / self.m])

    It is a frozen dataclass. Numbers that `array_leaf` makes array leaves have a gradient, and
    change without recompiling; Python's numbers are constants. Each attribute below may be a class
    attribute, a property or a field; of fields, sizes are static (`eqx.field(static=True)`).

    Attributes:
        nx, nu: sizes of the state and of the control, at least 1.
        discrete: True when the plant returns the next state rather than the state's derivative;
            False by default.
        control_bounds: (lower, upper), scalars or of shape (nu,), or None, the default.
        nominal_control: the control from which an optimisation starts, scalar or of shape (nu,);
            zeros by default. Muscles start at a small activation: at rest with no activation the
            gradient is exactly zero.
    """

    nx: eqx.AbstractVar[int]
    nu: eqx.AbstractVar[int]
    if TYPE_CHECKING:
        discrete: ClassVar[bool]
        control_bounds: ClassVar[Any]
        nominal_control: ClassVar[Any]
    else:
        discrete = _Default(lambda plant: False)
        control_bounds = _Default(lambda plant: None)
        nominal_control = _Default(lambda plant: jnp.zeros((plant.nu,), _dtype(plant)))

    @abc.abstractmethod
    def __call__(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], t: ArrayLike
    ) -> Float[Array, " nx"]:
        """Return the derivative of the state (continuous) or the next state (discrete), (nx,)."""


def control_bounds(plant: AbstractPlant) -> Bounds | None:
    """Return a plant's bounds as arrays, each (nu,), however its class states them; None without.

    Raises ValueError or TypeError, naming the plant's class, when they do not fit.
    """
    name, bounds = f"{type(plant).__name__}.control_bounds", plant.control_bounds
    if isinstance(bounds, Callable):
        raise TypeError(f"{name}: a pair (lower, upper) is wanted, got a method; @property?")
    return as_bounds(bounds, (plant.nu,), name)


def nominal_control(plant: AbstractPlant) -> Float[Array, " nu"]:
    """Return a plant's nominal control, shape (nu,), however its class states it.

    Raises ValueError or TypeError, naming the plant's class, when it does not fit.
    """
    name, value = f"{type(plant).__name__}.nominal_control", plant.nominal_control
    try:
        array = array_leaf(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: numbers are wanted, got {value!r}") from error
    if array.shape not in ((), (plant.nu,)):
        raise ValueError(f"{name}: shape {array.shape}, wanted () or ({plant.nu},)")
    dtype = array.dtype if eqx.is_array(value) else _dtype(plant)
    return jnp.broadcast_to(array.astype(dtype), (plant.nu,))


def check_plant(plant: AbstractPlant) -> None:
    """Raise ValueError or TypeError, naming the attribute, when a plant's attributes do not fit."""
    kind = type(plant).__name__
    for field in dataclasses.fields(plant):
        if field.name in ("nx", "nu", "discrete") and not field.metadata.get("static"):
            raise TypeError(
                f"{kind}.{field.name}: got a field that jit would trace; write "
                f"`{field.name}: ClassVar[...] = ...`, or eqx.field(static=True)"
            )
    for name in ("nx", "nu"):
        size = getattr(plant, name)
        try:
            wrong = isinstance(size, bool) or operator.index(size) < 1
        except TypeError:
            wrong = True
        if wrong:
            raise ValueError(f"{kind}.{name}: an integer of at least 1 is wanted, got {size!r}")
    if not isinstance(plant.discrete, bool):
        raise TypeError(f"{kind}.discrete: True or False is wanted, got {plant.discrete!r}")
    control_bounds(plant)
    nominal_control(plant)


class AbstractHand(AbstractPlant):
    """A plant with a hand that moves in the plane or in space: what every movement task asks for.

    Attributes:
        dim: of the space that the hand moves in: 2, the default, or 3; static.
        longest_reach: the largest distance of the hand from the origin [m], shape (); tasks refuse
            goals beyond it.
    """

    if TYPE_CHECKING:
        dim: ClassVar[int]
        longest_reach: ClassVar[Any]
    else:
        dim = _Default(lambda plant: 2)
        longest_reach: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def hand(self, x: Float[Array, " nx"]) -> Float[Array, " dim"]:
        """Return the position of the hand [m], shape (dim,), at a state x (nx,)."""

    @abc.abstractmethod
    def hand_velocity(self, x: Float[Array, " nx"]) -> Float[Array, " dim"]:
        """Return the velocity of the hand [m/s], shape (dim,), at a state x (nx,)."""


class AbstractArm(AbstractHand):
    """A plant of joints whose state begins with the joint angles and their velocities.

    State x = (q, dq, ...), with q of shape (num_joints,) in rad and dq in rad/s; the joints obey
    M(q) ddq = tau(x, u) + ..., with tau the torques that the arm is moved by.
    """

    num_joints: eqx.AbstractVar[int]

    @abc.abstractmethod
    def hand_of_joints(self, q: Float[Array, " num_joints"]) -> Float[Array, " dim"]:
        """Return the position e(q) of the hand [m], shape (dim,), for joint angles q [rad]."""

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""

    @abc.abstractmethod
    def joint_torque(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"]
    ) -> Float[Array, " num_joints"]:
        """Return the torques tau [N m] by which motors or muscles move the joints, (num_joints,).

        Friction and forces from outside are not among them.
        """

    def hand(self, x: Float[Array, " nx"]) -> Float[Array, " dim"]:
        """Return the position e(q) of the hand [m], shape (dim,), at a state x (nx,).

        Raises ValueError for another shape; a trajectory goes through `jax.vmap`.
        """
        self._check_state(x)
        return self.hand_of_joints(x[: self.num_joints])

    def hand_velocity(self, x: Float[Array, " nx"]) -> Float[Array, " dim"]:
        """Return the velocity of the hand, de/dq dq [m/s], shape (dim,); raises as `hand` does."""
        self._check_state(x)
        n = self.num_joints
        return jax.jvp(self.hand_of_joints, (x[:n],), (x[n : 2 * n],))[1]

    def _check_state(self, x) -> None:
        if jnp.shape(x) != (self.nx,):
            raise ValueError(
                f"x: got shape {jnp.shape(x)}, wanted ({self.nx},); a trajectory goes through "
                "jax.vmap(arm.hand)"
            )
