"""What a solve returns."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._checks import is_concrete
from ._controller import AffinePolicy
from ._solver import Record
from ._status import Status


def last_finite(xs: Float[Array, "T+1 nx"]) -> Float[Array, "T+1 nx"]:
    """Hold the last finite state where a trajectory (T+1, nx) is not finite."""
    finite = jnp.isfinite(xs).all(axis=1)
    last = jax.lax.cummax(jnp.where(finite, jnp.arange(len(xs)), 0))
    return xs[last]


class SolveError(RuntimeError):
    """Raised by `solve(..., throw=True)`; carries the status's message."""


class Solution(eqx.Module):
    """A trajectory, the policy around it, and how well it was found.

    Attributes:
        xs: states, shape (T+1, nx). us: controls, shape (T, nu).
        nominal_cost: cost of this trajectory. expected_cost: cost expected under the problem's
            noise when the solver plans with it; otherwise equal to the nominal one.
        policy: the affine policy around the trajectory; hand it to `simulate`.
        status: why the solver stopped: `status.ok`, `status.message`.
        gradient: projected gradient of the returned iterate, in the solver's relative measure.
        history: cost, projected gradient, accepted fraction and lambda of each iterate, each of
            shape (max_steps + 1,), padded with NaN; of a solver without iterates, shape (1,).
        num_steps: number of iterations done.

    Printed, it is a small table; under vmap all arrays have a leading batch axis.
    """

    xs: Float[Array, "*batch T+1 nx"]
    us: Float[Array, "*batch T nu"]
    nominal_cost: Float[Array, " *batch"]
    expected_cost: Float[Array, " *batch"]
    policy: AffinePolicy
    status: Status
    gradient: Float[Array, " *batch"]
    history: Record
    num_steps: Int[Array, " *batch"]

    @property
    def cost(self) -> Float[Array, " *batch"]:
        """The cost that the solver minimised, shape () or the batch's."""
        return self.expected_cost

    def __str__(self) -> str:
        if not is_concrete(self.status.code, self.nominal_cost):
            return eqx.tree_pformat(self)
        shape = np.shape(self.status.code)
        ok = np.asarray(self.status.ok)
        rows = [("cost", _spread(self.cost)), ("gradient", _spread(self.gradient))]
        rows.append(("iterations", _spread(self.num_steps)))
        if shape:
            size = int(np.prod(shape))
            head = f"Solution of {size} problems, {int(ok.sum())} converged"
        else:
            head = "Solution, " + ("converged" if ok else "NOT converged")
            rows.insert(0, ("reason", self.status.name))
        lines = [head] + [f"  {name:<11}{value}" for name, value in rows]
        lines += [f"  {line}" for line in self.status.message.split("\n")]
        return "\n".join(lines)


def _spread(values) -> str:
    values = np.asarray(values)
    if values.ndim == 0:
        return f"{values:.6g}"
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return "none finite"
    return f"{np.min(finite):.6g} ... {np.max(finite):.6g} (median {np.median(finite):.6g}" + (
        f", {values.size - finite.size} not finite)" if finite.size < values.size else ")"
    )
