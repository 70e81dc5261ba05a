"""What an experiment does to a movement from outside: forces, and shifts of what is or is seen."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._checks import check_array
from ._linalg import solve_positive
from ._plant import AbstractArm, AbstractPlant
from ._types import array_leaf


def _rows(value: ArrayLike | None) -> Array | None:
    return None if value is None else array_leaf(value)


class Pulses(eqx.Module):
    """Perturbations from outside, a row for each step: `simulate(..., pulses=Pulses(forces=F))`.

    x_{k+1} = step of f(x, u_k, t) + (0, M^-1 J'F_k, 0), plus states_k;    y_k = x_k + sensed_k

    With a sensor y_k is what that says of x_k, plus sensed_k.

    What acts from some time on is the same in every row from there. A cursor that jumps is an
    offset of what is sensed; a target that jumps by d is, to a policy made for the first target,
    the same as a hand sensed at -d. The problem's cost does not follow: where the target moved, the
    cost is that of another problem, `other.total_cost(trajectory.xs, trajectory.us)`.

    `sensed` shifts the state. For an arm with joints q the shift dq of a target's jump by d [m] has
    J(q) dq = -d, to first order in d:

        J = jax.jacobian(arm.hand_of_joints)(q)  # q: the joints around the time of the jump
        sensed = jnp.zeros((T, arm.nx)).at[k:, : q.size].set(jnp.linalg.lstsq(J, -d)[0])

    Arguments:
        forces: F on the hand [N], held over each step, shape (T, dim); for an arm, whose joints
            they accelerate.
        states: what is added to the state at the end of each step, shape (T, nx).
        sensed: what is added to what the controller senses at each step, shape (T, ny).

    Each is None by default. `simulate` raises ValueError, naming the argument, for other shapes,
    for numbers that are not finite, and for forces on a plant without joints.
    """

    forces: Float[Array, "T dim"] | None = eqx.field(converter=_rows, default=None)
    states: Float[Array, "T nx"] | None = eqx.field(converter=_rows, default=None)
    sensed: Float[Array, "T ny"] | None = eqx.field(converter=_rows, default=None)

    def check(self, plant: AbstractPlant, num_steps: int, num_readings: int | None = None) -> None:
        """Raise ValueError for a plant (nx,), a number of steps or of readings that these miss.

        What is sensed is the state, (nx,), if no number of readings is given.
        """
        sensed = plant.nx if num_readings is None else num_readings
        widths: dict[str, int] = {"states": plant.nx, "sensed": sensed}
        if self.forces is not None:
            widths["forces"] = _dim(plant)
        for name, width in widths.items():
            if (rows := getattr(self, name)) is not None:
                check_array(f"pulses.{name}", rows, (num_steps, width), "one row for each step")


def _dim(plant: AbstractPlant) -> int:
    """Return the number of coordinates of a hand that forces can push."""
    if not isinstance(plant, AbstractArm) or plant.discrete:
        raise ValueError(
            "pulses.forces: a continuous plant with joints is wanted, such as jc.plants.TorqueArm, "
            f"which forces on the hand accelerate; got {type(plant).__name__}"
        )
    q = jax.ShapeDtypeStruct((plant.num_joints,), jnp.result_type(float))
    return jax.eval_shape(plant.hand_of_joints, q).shape[0]


class Pushed(AbstractPlant):
    """An arm with a force F (dim,) [N] on its hand, held for one step."""

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    control_bounds: Any
    nominal_control: Any
    arm: AbstractArm
    force: Float[Array, " dim"]

    def __init__(self, arm: AbstractArm, force: Float[Array, " dim"]):
        self.nx, self.nu, self.discrete = arm.nx, arm.nu, arm.discrete
        self.control_bounds, self.nominal_control = arm.control_bounds, arm.nominal_control
        self.arm, self.force = arm, force

    def __call__(self, x, u, t):
        """Return the arm's derivative with M^-1 J'F added to the accelerations, shape (nx,)."""
        return self.arm(x, u, t) + push(self.arm, x, self.force)


def push(
    arm: AbstractArm, x: Float[Array, " nx"], force: Float[Array, " dim"]
) -> Float[Array, " nx"]:
    """Return what a force on the hand [N], (dim,), adds to an arm's derivative: (0, M^-1 J'F, 0).

    J = de/dq is the Jacobian of the hand's position at the state x (nx,).
    """
    n = arm.num_joints
    (torque,) = jax.vjp(arm.hand_of_joints, x[:n])[1](force)
    acceleration, _ = solve_positive(arm.mass_matrix(x[:n]), torque[:, None])
    return jnp.zeros_like(x).at[n : 2 * n].set(acceleration[:, 0])
