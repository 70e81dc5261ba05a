"""Why a solve stopped: a status that travels through jit and vmap and says its reason in words."""

import enum

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int


class Reason(enum.IntEnum):
    """Reasons for which an iteration ends; the first six are successes.

    `reason.message` says what each means, and what to do: `for r in jc.Reason: print(r.message)`.
    """

    CONVERGED_GRADIENT = 0
    CONVERGED_COST = 1
    CONVERGED_STEP = 2
    CONVERGED_ROUND_OFF = 3
    CONVERGED_COLLOCATION = 4
    STATIONARY_START = 5
    RUNNING = 6
    MAX_STEPS = 7
    NEARLY_CONVERGED = 8
    STALLED = 9
    LINE_SEARCH_FAILED = 10
    REGULARISATION_EXHAUSTED = 11
    UNBOUNDED_COST = 12
    BVP_MAX_NODES = 13
    BVP_SINGULAR = 14
    BVP_DIVERGED = 15
    BVP_NO_MINIMUM = 16
    BVP_OFF_GRID = 17
    NONFINITE_INPUT = 18
    INFEASIBLE_BOUNDS = 19
    NONFINITE_DYNAMICS = 20
    NONFINITE_COST = 21
    NONFINITE_DERIVATIVE = 22
    INVALID_TIME_STEP = 23
    STALLED_EXPECTED = 24
    NOISE_TOO_LARGE = 25
    INVALID_COVARIANCE = 26
    NONFINITE_NOISE = 27

    @property
    def message(self) -> str:
        """Say the reason in one sentence; `{index}` stands for the step of the trajectory."""
        return _MESSAGES[self]


_MESSAGES = {
    Reason.CONVERGED_GRADIENT: "converged: the projected gradient is at its tolerance and the "
    "cost cannot be lowered further, but for round-off",
    Reason.CONVERGED_COST: "converged: the gradient and the relative reduction of the cost are "
    "below their tolerances",
    Reason.CONVERGED_STEP: "converged: the gradient and the relative step of the controls are "
    "below their tolerances",
    Reason.CONVERGED_ROUND_OFF: "converged as far as float32 can tell: the expected reduction of "
    "the cost is at round-off, though the projected gradient is above its tolerance",
    Reason.CONVERGED_COLLOCATION: "converged: the boundary-value problem of the continuous-time "
    "problem is solved to its tolerance; cost and gradient are those on the grid, whose optimum is "
    "another",
    Reason.STATIONARY_START: "stationary at the start: no step was needed. Fine for a warm start; "
    "if the start was a guess, it may be a saddle or a maximum: perturb `us` to tell",
    Reason.RUNNING: "still running",
    Reason.MAX_STEPS: "not converged: the maximum number of steps was reached; raise "
    "`max_steps`, or start nearer",
    Reason.NEARLY_CONVERGED: "not converged, though near: the maximum number of steps was reached "
    "with a projected gradient within 100 times its tolerance",
    Reason.STALLED: "not converged: the expected reduction of the cost is at round-off, but the "
    "projected gradient is above its tolerance; scale the problem, or use float64",
    Reason.LINE_SEARCH_FAILED: "not converged: no step along the search direction lowers the cost, "
    "even down the gradient, or with the largest regularisation; if `gradient` is small, this is "
    "round-off",
    Reason.REGULARISATION_EXHAUSTED: "failed: the Hessian of the controls is not positive definite "
    "at step {index}, even with the largest regularisation",
    Reason.UNBOUNDED_COST: "failed: the cost falls without end, 1/eps times below its start; price "
    "the controls or the states, or bound the controls",
    Reason.BVP_MAX_NODES: "not converged: the mesh of the boundary-value problem reached "
    "`max_nodes`, or intervals at round-off",
    Reason.BVP_SINGULAR: "failed: a singular Jacobian in the collocation system of the "
    "boundary-value problem; start from other controls `us`",
    Reason.BVP_DIVERGED: "not converged: Newton's method does not solve the collocation system of "
    "the boundary-value problem; start from other controls `us`",
    Reason.BVP_NO_MINIMUM: "failed: at step {index} the Hamiltonian has no strict minimum in the "
    "controls, so that a solution of the boundary-value problem need not be optimal",
    Reason.BVP_OFF_GRID: "not converged: the boundary-value problem is solved, but held over the "
    "problem's steps its controls cost over 1.1 times as much as in continuous time; shorten dt, "
    "use RK4, or a solver on the grid",
    Reason.NONFINITE_INPUT: "failed: x0, us or a parameter of the problem is not finite",
    Reason.INFEASIBLE_BOUNDS: "failed: a lower control bound lies above its upper bound at step "
    "{index}",
    Reason.NONFINITE_DYNAMICS: "failed: the dynamics are not finite at step {index} of the "
    "starting trajectory; start from other controls `us`, or shorten dt",
    Reason.NONFINITE_COST: "failed: the cost is not finite at step {index} of the starting "
    "trajectory; start from other controls `us`, or, at step 0, from another x0",
    Reason.NONFINITE_DERIVATIVE: "failed: a derivative of the dynamics or of the cost is not "
    "finite at step {index}, where its value is",
    Reason.INVALID_TIME_STEP: "failed: the time step dt is not above zero",
    Reason.INVALID_COVARIANCE: "failed: x0_cov is no covariance: it is not symmetric, or "
    "has a negative eigenvalue",
    Reason.NONFINITE_NOISE: "failed: the noise, or what is sensed, or a slope of these, is not "
    "finite at step {index} of the trajectory; a norm has no slope at zero",
    Reason.NOISE_TOO_LARGE: "failed: the noise adds over 1/eps times what the start costs without "
    "it, or overflows: no feedback holds it; lower its intensity, or shorten the movement",
    Reason.STALLED_EXPECTED: "not converged: no step lowers the expected cost, and none the "
    "gradient of the model, which leaves out a part of what noise costs; returned is the best pair "
    "of trajectory and gains; lower the noise, or start from the solution of a lower one",
}


_FEEDBACK_NEEDED = (
    "the plant is unstable: its controls alone, run again, do not cost the same, since rounding "
    "errors grow; run the policy (jc.audit tells more)"
)


class Status(eqx.Module):
    """A reason, the step of the trajectory that it concerns, and whether feedback is needed.

    Attributes:
        code: the reason's number. index: the step, -1 where it concerns none.
        feedback_needed: whether the controls alone, their last digits changed, lead to other states
            and another cost, both by more than sqrt(eps), though the solve converged; None where
            nobody has looked.

    All are arrays, batched under vmap like everything else.
    """

    code: Int[Array, " *batch"]
    index: Int[Array, " *batch"]
    feedback_needed: Bool[Array, " *batch"] | None = None

    @classmethod
    def of(cls, reason: Reason, index: ArrayLike = -1) -> "Status":
        """Return the status for `reason` at `index`."""
        return cls(jnp.asarray(int(reason), jnp.int32), jnp.asarray(index, jnp.int32))

    def is_(self, reason: Reason) -> Array:
        """Tell whether this is `reason`; a boolean array of the batch's shape."""
        return self.code == int(reason)

    @property
    def ok(self) -> Array:
        """Whether the solve converged; a boolean array of the batch's shape."""
        return self.code <= int(Reason.STATIONARY_START)

    @property
    def message(self) -> str:
        """Say in words why the solve stopped; for a batch, one line for each reason met."""
        if isinstance(self.code, jax.core.Tracer):
            return "unknown while tracing"
        codes, indices = np.asarray(self.code), np.asarray(self.index)
        feedback = np.asarray(False if self.feedback_needed is None else self.feedback_needed)
        if codes.ndim == 0:
            message = Reason(int(codes)).message.format(index=int(indices))
            return f"{message}. But {_FEEDBACK_NEEDED}" if feedback else message
        lines = []
        for code, count in zip(*np.unique(codes, return_counts=True), strict=True):
            where = sorted({int(i) for i in indices[codes == code]})
            shown = ", ".join(map(str, where[:5])) + (", ..." if len(where) > 5 else "")
            lines.append(
                f"{count} of {codes.size} " + Reason(int(code)).message.format(index=shown)
            )
        if feedback.any():
            lines.append(f"{feedback.sum()} of {codes.size}: {_FEEDBACK_NEEDED}")
        return "\n".join(lines)

    @property
    def name(self) -> str:
        """Name the reason of a single, concrete status, such as "CONVERGED_COST".

        Raises ValueError for a batch, whose reasons `message` counts.
        """
        if self.code.ndim > 0:
            raise ValueError(f"name: one status is wanted, got {self.code.shape}; see `message`")
        return Reason(int(self.code)).name


def where(condition: Array, yes: Status, no: Status) -> Status:
    """Choose between two statuses, element by element."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def first_nonfinite(values: Array) -> Int[Array, ""]:
    """Return the first index along time at which `values` (T, ...) are not finite, or -1."""
    bad = ~jnp.isfinite(values).reshape(values.shape[0], -1).all(axis=1)
    return jnp.where(bad.any(), jnp.argmax(bad), -1).astype(jnp.int32)
