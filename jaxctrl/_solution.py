"""What a solve returns."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._checks import is_concrete
from ._controller import AffinePolicy
from ._estimator import LinearFilter, OutputFeedback
from ._prediction import Prediction
from ._solver import Record
from ._status import Reason, Status

if TYPE_CHECKING:
    import xarray


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
        policy: the affine policy around the trajectory; hand it to `simulate`. Of a solver that
            plans with the problem's sensor, that policy with an estimator, an `OutputFeedback`.
        status: why the solver stopped: `status.ok`, `status.message`.
        gradient: projected gradient of the returned iterate, in the solver's relative measure.
        history: cost, projected gradient, accepted fraction and lambda of each iterate, each of
            shape (max_steps + 1,), padded with NaN; of a solver without iterates, shape (1,).
        num_steps: number of iterations done.
        prediction: means and covariances under the policy, from a solver that plans with the noise;
            None otherwise, and where nothing is uncertain.

    Printed, it is a small table; under vmap all arrays have a leading batch axis.
    """

    xs: Float[Array, "*batch T+1 nx"]
    us: Float[Array, "*batch T nu"]
    nominal_cost: Float[Array, " *batch"]
    expected_cost: Float[Array, " *batch"]
    policy: AffinePolicy | OutputFeedback
    status: Status
    gradient: Float[Array, " *batch"]
    history: Record
    num_steps: Int[Array, " *batch"]
    prediction: Prediction | None = None

    @property
    def cost(self) -> Float[Array, " *batch"]:
        """The cost that the solver minimised, shape () or the batch's."""
        return self.expected_cost

    def to_xarray(self) -> "xarray.Dataset":
        """Return everything as an `xarray.Dataset`, with named dimensions, for known values.

        Dimensions: `batch` (`batch_0`, ... for several), `time` (T+1,), `step` (T,), `state`,
        `control`, `iterate`. Coordinates: `ts` [s] of the states, `step_ts` [s] of the starts of
        the steps. The gains are `K` and `k`, `lower` and `upper` the bounds if any, `reason` names
        the status, whose message is an attribute; predicted covariances, if any, are `x_cov`,
        `u_cov` and `error_cov`. With a sensor `K` acts on a `belief`, which a filter of gains `G`
        makes of the `reading`s.
        `solution.to_xarray().to_netcdf(path)` writes a file for other programs; `jc.save` one to go
        on with.

        Raises ValueError under jit, vmap or grad.
        """
        return _dataset(self)

    def __str__(self) -> str:
        if not is_concrete(self.status.code, self.nominal_cost):
            return eqx.tree_pformat(self)
        shape = np.shape(self.status.code)
        ok = np.asarray(self.status.ok)
        rows = [("cost", _spread(self.cost)), ("gradient", _spread(self.gradient))]
        if self.prediction is not None:
            rows[:1] = [("expected", rows[0][1]), ("nominal", _spread(self.nominal_cost))]
        rows.append(("iterations", _spread(self.num_steps)))
        if shape:
            size = int(np.prod(shape))
            head = f"Solution of {size} problems, {int(ok.sum())} converged"
        else:
            head = "Solution, " + ("converged" if ok else "NOT converged")
            rows.insert(0, ("reason", self.status.name))
            rows += _held(self.policy)
        lines = [head] + [f"  {name:<11}{value}" for name, value in rows]
        lines += [f"  {line}" for line in self.status.message.split("\n")]
        return "\n".join(lines)


def _held(policy: AffinePolicy | OutputFeedback) -> list[tuple[str, str]]:
    """Say how many controls lie on a bound: gains of zero are no fault there."""
    if policy.bounds is None or not is_concrete(policy.us, policy.K, *policy.bounds):
        return []
    us, (lower, upper) = np.asarray(policy.us), map(np.asarray, policy.bounds)
    held = ((us == lower) | (us == upper)) & (np.asarray(policy.K) == 0).all(axis=-1)
    text = f"{held.sum()} of {held.size} controls, whose gains are zero"
    return [("at bounds", text)] if held.any() else []


def _dataset(solution: Solution) -> "xarray.Dataset":
    import xarray

    if not is_concrete(*jax.tree.leaves(solution)):
        raise ValueError("to_xarray: known values are wanted, got traced ones; call it outside jit")
    policy, code = solution.policy, np.asarray(solution.status.code)
    batch = ("batch",) if code.ndim == 1 else tuple(f"batch_{i}" for i in range(code.ndim))
    reasons = np.array([Reason(int(c)).name for c in code.reshape(-1)]).reshape(code.shape)
    sensed = isinstance(policy, OutputFeedback)
    variables = {
        "xs": (("time", "state"), solution.xs),
        "us": (("step", "control"), solution.us),
        "k": (("step", "control"), policy.k),
        "K": (("step", "control", "belief" if sensed else "state"), policy.K),
        "nominal_cost": ((), solution.nominal_cost),
        "expected_cost": ((), solution.expected_cost),
        "reason": ((), reasons),
        "status_index": ((), solution.status.index),
        "gradient": ((), solution.gradient),
        "num_steps": ((), solution.num_steps),
    }
    if solution.prediction is not None:
        variables["x_cov"] = (("time", "state", "state_"), solution.prediction.x_cov)
        if solution.prediction.error_cov is not None:
            variables["error_cov"] = (("time", "state", "state_"), solution.prediction.error_cov)
        variables["u_cov"] = (("step", "control", "control_"), solution.prediction.u_cov)
    for name, values in solution.history._asdict().items():
        variables[f"history_{name}"] = (("iterate",), values)
    if sensed and isinstance(policy.estimator, LinearFilter):
        variables["G"] = (("step", "belief", "reading"), policy.estimator.G)
    if policy.bounds is not None:
        for name, bound in zip(("lower", "upper"), policy.bounds, strict=True):
            variables[name] = (("step", "control"), bound)
    coords = {}
    if policy.dt is not None:
        ts = np.asarray(policy.dt)[..., None] * np.arange(solution.xs.shape[-2])
        seconds = {"units": "s"}
        coords["ts"] = ((*batch, "time"), ts, {**seconds, "long_name": "time of the state"})
        coords["step_ts"] = ((*batch, "step"), ts[..., :-1], {**seconds, "long_name": "start"})
    return xarray.Dataset(
        {name: ((*batch, *dims), np.asarray(value)) for name, (dims, value) in variables.items()},
        coords,
        {"status": solution.status.message, "ok": int(np.all(solution.status.ok))},
    )


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
