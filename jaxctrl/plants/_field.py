"""Force fields on the hand, as robots make them, and an arm that moves in one."""

import abc
from dataclasses import KW_ONLY
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._pulses import push
from .._types import Bounds
from ._parameters import known, parameter
from ._rate import RateControlled


def _vector(name: str, value: ArrayLike) -> Array:
    if jnp.shape(value) not in ((), (2,), (3,)):
        raise ValueError(f"{name}: shape {jnp.shape(value)}, wanted (2,), or (3,) in space")
    return parameter(name, value, jnp.shape(value) or (2,))


class AbstractField(eqx.Module):
    """A force on the hand [N]: `field(position, velocity, t)`, for a hand at (dim,) [m]."""

    @abc.abstractmethod
    def __call__(
        self, position: Float[Array, " dim"], velocity: Float[Array, " dim"], t: ArrayLike
    ) -> Float[Array, " dim"]:
        """Return the force [N], shape (dim,), at a position [m] and velocity [m/s], each (dim,)."""


class Curl(AbstractField):
    """Push the hand across its velocity, F = b (v_y, -v_x): clockwise for b > 0.

    The velocity-dependent field of Shadmehr & Mussa-Ivaldi (1994), in its curl form, in the plane.

    Arguments:
        gain: b [N s/m]; 13 is usual.

    Raises ValueError for a gain that is not one finite number.
    """

    gain: Float[Array, ""] = eqx.field(converter=partial(parameter, "gain"), default=13.0)

    def __call__(self, position, velocity, t):
        """Return b (v_y, -v_x) [N], shape (2,)."""
        return self.gain * jnp.stack([velocity[1], -velocity[0]])


class ConstantForce(AbstractField):
    """Push the hand with a constant force.

    Arguments:
        force: F [N], shape (2,), or (3,) in space.

    Raises ValueError for a force of another shape, or not finite.
    """

    force: Float[Array, " dim"] = eqx.field(converter=partial(_vector, "force"))

    def __call__(self, position, velocity, t):
        """Return F [N], shape (dim,)."""
        return self.force


class Channel(AbstractField):
    """Hold the hand on a straight line by a stiff, damped wall on either side.

    F = -(k d + c dd/dt), with d the vector to the hand from the nearest point of the line through
    `start` and `target`: an error clamp (Scheidt, Reinkensmeyer, Conditt, Rymer & Mussa-Ivaldi
    2000). The force on a wall, which such experiments measure, is `channel(position, velocity, t)`.

    Arguments:
        start, target: two points of the line [m], each (2,), or (3,) in space.
        stiffness: k [N/m]. damping: c [N s/m]. 2000 and 50 are our choice: stiffer walls need a
            time step below 10 ms, or RK4.

    Raises ValueError for a wrong shape, a negative number, or points that coincide.
    """

    start: Float[Array, " dim"] = eqx.field(converter=partial(_vector, "start"))
    target: Float[Array, " dim"] = eqx.field(converter=partial(_vector, "target"))
    _: KW_ONLY
    stiffness: Float[Array, ""] = eqx.field(
        converter=partial(parameter, "stiffness", minimum=0.0), default=2000.0
    )
    damping: Float[Array, ""] = eqx.field(
        converter=partial(parameter, "damping", minimum=0.0), default=50.0
    )

    def __check_init__(self):
        if self.start.shape != self.target.shape:
            raise ValueError(f"target: shape {self.target.shape}, wanted {self.start.shape}")
        ends = known(self.start), known(self.target)
        if ends[0] is not None and ends[1] is not None and (ends[0] == ends[1]).all():
            raise ValueError("target: the same as start, so that no line goes through both")

    def __call__(self, position, velocity, t):
        """Return -(k d + c dd/dt) [N], shape (dim,)."""
        along = self.target - self.start
        along = along / jnp.sqrt(jnp.sum(along**2))
        pull = self.stiffness * (position - self.start) + self.damping * jnp.asarray(velocity)
        return along * jnp.sum(along * pull) - pull


class InField(AbstractArm):
    """Move an arm whose hand is pushed by a force field.

    M(q) ddq = tau - C(q, dq) - B dq + J(q)'F(e, de/dt, t),  J = de/dq

    State and control are those of the arm, which makes the starting state: `arm.at_rest(...)`.
    Fields add up by wrapping an arm twice. A feedback law made without the field may do harm in it
    where its controls are at their bounds, as muscles' excitations mostly are: it is a local law.

    Arguments:
        arm: any arm.
        field: the force F on its hand, such as `Curl()`.

    Raises TypeError for what is no arm or no field, or a `RateControlled` arm, which takes the
    field inside; ValueError for a discrete arm, or a force of another shape than the hand's.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    num_joints: int = eqx.field(static=True)
    arm: AbstractArm
    field: AbstractField

    def __init__(self, arm: AbstractArm, field: AbstractField):
        if not isinstance(arm, AbstractArm):
            raise TypeError(f"arm: a plant with joints is wanted, got {type(arm).__name__}")
        if not isinstance(field, AbstractField):
            hint = f"; write {field.__name__}()" if isinstance(field, type) else ""
            raise TypeError(f"field: a force field such as Curl() is wanted, got {field!r}{hint}")
        if isinstance(arm, RateControlled):
            raise TypeError("arm: put the field inside, RateControlled(InField(arm, field))")
        if arm.discrete:
            raise ValueError("arm: a continuous plant is wanted, got a discrete one")
        hand = jnp.zeros((arm.dim,))
        shape = getattr(jax.eval_shape(field, hand, hand, 0.0), "shape", None)
        if shape != (arm.dim,):
            raise ValueError(f"field: a force of shape {shape}, wanted ({arm.dim},)")
        self.nx, self.nu, self.num_joints = arm.nx, arm.nu, arm.num_joints
        self.arm, self.field = arm, field

    @property
    def control_bounds(self) -> Bounds | None:
        """Bounds of the arm's controls, each (nu,), or None."""
        return self.arm.control_bounds

    @property
    def nominal_control(self) -> Float[Array, " nu"]:
        """The arm's nominal control, shape (nu,)."""
        return self.arm.nominal_control

    def __call__(self, x, u, t):
        """Return the arm's derivative with M^-1 J'F added to the accelerations, shape (nx,)."""
        n = self.num_joints
        q, dq = x[:n], x[n : 2 * n]
        hand, velocity = jax.jvp(self.hand_of_joints, (q,), (dq,))
        return self.arm(x, u, t) + push(self.arm, x, self.field(hand, velocity, t))

    @property
    def dim(self) -> int:
        """That of the arm's hand, 2 or 3."""
        return self.arm.dim

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """That of the arm [m], shape ()."""
        return self.arm.longest_reach

    def hand_of_joints(self, q: Float[Array, " n"]) -> Float[Array, " dim"]:
        """Return the hand's position [m], shape (dim,), for joint angles q (n,) [rad]."""
        return self.arm.hand_of_joints(q)

    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""
        return self.arm.mass_matrix(q)

    def joint_torque(self, x: Float[Array, " nx"], u: Float[Array, " nu"]) -> Float[Array, " n"]:
        """Return the arm's own torques [N m], shape (n,), without the field's."""
        return self.arm.joint_torque(x, u)
