"""What the optimality models ask for: smooth torques, a smooth hand, and to end in balance."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._fields import WEIGHT
from .._plant import nominal_control
from .._terms import AbstractEnd, AbstractRate, AbstractResidual
from .._types import array_leaf


class TorqueChange(AbstractResidual):
    """Cost w/2 int |dtau/dt|^2 dt of changing the joint torques (Uno, Kawato & Suzuki 1989).

    Li (2006), eq. 2.3. dtau/dt is the change over a step divided by dt: a derivative at the
    beginning of the step would not see a muscle that is switched on from rest, where its force is
    flat, and the optimum of that cost is to switch muscles on and off in turn.

    Arguments:
        weight: w [s/(N m)^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1e-7)
    of: ClassVar[str] = "effort"

    def residual(self, plant: Any, at):
        """Return sqrt(w) (tau(x') - tau(x))/dt, shape (num_joints,)."""
        change = plant.joint_torque(at.after, at.u) - plant.joint_torque(at.x, at.u)
        return _root(self.weight) * change / at.dt


class HandJerk(AbstractResidual, AbstractEnd):
    """Cost w/2 int |d^3 e/dt^3|^2 dt of an arm's hand, and w_a |d^2 e/dt^2(T)|^2 at the end.

    Li (2006), eq. 2.1; the jerk is the change of the hand's acceleration over a step.

    Arguments:
        weight: w [s^5/m^2]. acceleration_weight: w_a [s^4/m^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1e-10)
    acceleration_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=1e-4
    )
    of: ClassVar[str] = "effort"

    def residual(self, plant: Any, at):
        """Return sqrt(w) (d^2 e/dt^2(x') - d^2 e/dt^2(x))/dt, shape (2,)."""
        change = _hand_acceleration(plant, at.after, at.u) - _hand_acceleration(plant, at.x, at.u)
        return _root(self.weight) * change / at.dt

    def end(self, plant: Any, x):
        """Return w_a |d^2 e/dt^2|^2, shape ()."""
        acceleration = _hand_acceleration(plant, x, nominal_control(plant))
        return self.acceleration_weight * jnp.sum(acceleration**2)


def _root(weight):
    """Return sqrt(w), with a finite slope at zero: a model that has no weight yet may get some."""
    return jnp.sqrt(weight + jnp.finfo(weight.dtype).tiny)


def _hand_acceleration(plant, x, u):
    """Return the hand's acceleration [m/s^2], shape (2,), where it does not depend on u."""
    return jax.jvp(plant.hand_velocity, (x,), (plant(x, u, jnp.zeros((), x.dtype)),))[1]


class PolynomialJerkCost(AbstractRate, AbstractEnd):
    """Cost w/2 int |d^3 e/dt^3|^2 dt of a `FreeHand`, and w_a |d^2 e/dt^2(T)|^2 at the end.

    Exactly the integral over each step: w/2 (|c_0|^2 + |c_1|^2/3 + |c_2|^2/5) per second. It is
    quadratic, so that the problem is linear-quadratic.

    Arguments:
        weight: w [s^5/m^2]. acceleration_weight: w_a [s^4/m^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1e-10)
    acceleration_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=1e-4
    )
    of: ClassVar[str] = "effort"

    def rate(self, plant: Any, at):
        """Return the mean of the squared jerk over a step, times w/2, shape ()."""
        squares = jnp.sum(at.u.reshape(3, 2) ** 2, axis=1)
        return 0.5 * self.weight * (squares[0] + squares[1] / 3 + squares[2] / 5)

    def end(self, plant: Any, x):
        """Return the cost of an acceleration at the end, shape ()."""
        return self.acceleration_weight * jnp.sum(x[4:] ** 2)


class Balance(AbstractEnd):
    """Cost w |M(q) ddq|^2 of the net joint torque at the end: zero where the arm would stay.

    With dq = 0 this asks that the torques hold the posture.

    Arguments:
        weight: w [1/(N m)^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1e-4)
    of: ClassVar[str] = "effort"

    def end(self, plant: Any, x):
        """Return w |M(q) ddq|^2, shape ()."""
        n = plant.num_joints
        rate = plant(x, nominal_control(plant), jnp.zeros((), x.dtype))
        return self.weight * jnp.sum((plant.mass_matrix(x[:n]) @ rate[n : 2 * n]) ** 2)
