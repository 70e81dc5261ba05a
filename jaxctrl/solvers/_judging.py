"""How every iteration judges an iterate: in what measure, within what tolerances, in what words."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import _status
from .._controller import clip
from .._linalg import is_covariance
from .._problem import Problem
from .._status import Reason, Status, first_nonfinite
from .._types import Bounds, LocalModel
from ..linear import Sweep


class Tolerances(eqx.Module):
    """When an iterate counts as converged; None takes the default of the dtype at hand.

    Attributes:
        gradient: bound on the relative projected gradient, which every success satisfies but
            float32's `CONVERGED_ROUND_OFF` and `BoundaryValue`'s own; 20 eps^0.4, 1.1e-5 in float64
            and 0.03 in float32. It is sqrt(sum D p^2 / |J|), with D the |diagonal of Q_uu|, g the
            gradient of the cost J in the controls and p = u - clip(u - g/D) over all times and
            controls: free of units, and its square twice the relative reduction of J that steps
            -g/D expect.
        cost: bound on the expected reduction of the cost relative to it; eps^(2/3), 4e-11 in
            float64.
        step: bound on the largest change of a control relative to the largest control;
            eps^(1/2), 1.5e-8 in float64.
    """

    gradient: float | None = eqx.field(static=True, default=None)
    cost: float | None = eqx.field(static=True, default=None)
    step: float | None = eqx.field(static=True, default=None)

    def resolve(self, dtype) -> tuple[float, float, float]:
        """Return the three numbers for a dtype: gradient, cost, step."""
        eps = float(jnp.finfo(dtype).eps)
        defaults = (20 * eps**0.4, eps ** (2 / 3), eps**0.5)
        given = (self.gradient, self.cost, self.step)
        return tuple(  # pyright: ignore[reportReturnType]
            d if g is None else float(g) for g, d in zip(given, defaults, strict=True)
        )


def input_status(problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> Status:
    """Return RUNNING, or what forbids to start: crossing bounds, dt <= 0, what is no covariance,
    inputs not finite.

    Arguments: the problem, x0 (nx,) and us (T, nu).
    """
    bounds = problem.bounds
    status = Status.of(Reason.RUNNING)
    if bounds is not None:
        crossed = (bounds[0] > bounds[1]).any(axis=1)
        infeasible = Status.of(Reason.INFEASIBLE_BOUNDS, jnp.argmax(crossed))
        status = _status.where(crossed.any(), infeasible, status)
    status = _status.where(problem.dt > 0, status, Status.of(Reason.INVALID_TIME_STEP))
    if problem.x0_cov is not None:
        valid = is_covariance(problem.x0_cov)
        status = _status.where(valid, status, Status.of(Reason.INVALID_COVARIANCE))
    parts = (problem.plant, problem.cost, problem.noise, problem.x0_cov, problem.dt, x0, us)
    every = jax.tree_util.tree_leaves_with_path(parts)
    inputs = [
        leaf
        for path, leaf in every
        # Bounds alone may be infinite.
        if eqx.is_inexact_array(leaf) and "control_bounds" not in jax.tree_util.keystr(path)
    ]
    finite = jnp.isfinite(jax.flatten_util.ravel_pytree(inputs)[0]).all()
    if bounds is not None:
        finite &= ~jnp.isnan(bounds[0]).any() & ~jnp.isnan(bounds[1]).any()
    return _status.where(finite, status, Status.of(Reason.NONFINITE_INPUT))


def no_sweep(us: Float[Array, "T nu"], nx: int) -> Sweep:
    """Return what stands for the law before any was computed: zeros, and not ok.

    Arguments: us (T, nu) gives shapes and dtype; nx, the number of states.
    """
    none, number = jnp.zeros_like(us), jnp.zeros((), us.dtype)
    whole = jnp.array(-1, jnp.int32)
    return Sweep(
        k=none,
        K=jnp.zeros((*us.shape, nx), us.dtype),
        gradient=none,
        curvature=none,
        linear=number,
        quadratic=number,
        ok=jnp.array(False),
        failed=whole,
        nonfinite=whole,
        settled=jnp.array(False),
    )


def cost_scale(cost: Float[Array, ""], start_cost: Float[Array, ""]) -> Float[Array, ""]:
    """Return the cost to which changes are compared: |cost|, or eps |start cost| below that."""
    eps = jnp.finfo(cost.dtype).eps
    scale = jnp.maximum(jnp.abs(cost), eps * jnp.abs(start_cost))
    return jnp.where(scale > 0, scale, 1.0)


def projected_gradient(
    us: Float[Array, "T nu"],
    gradient: Float[Array, "T nu"],
    curvature: Float[Array, "T nu"],
    scale: Float[Array, ""],
    bounds: Bounds | None,
) -> Float[Array, ""]:
    """Measure the gradient dJ/du, free of units.

    sqrt(sum_ki D_ki p_ki^2 / |J|), with p = u - clip(u - g/D) the projected step down the gradient
    g and D the |diagonal| of Q_uu: its square is twice the relative reduction of the cost
    that a diagonal Newton step expects. It changes with neither the cost's unit nor the
    controls'.

    Arguments: us, gradient, curvature of shape (T, nu); scale, the |J|; bounds (T, nu) or None.
    """
    D = metric(curvature, price_of_moving(us, gradient))
    p = us - clip(us - gradient / D, bounds)
    return jnp.sqrt(jnp.sum(D * p * p / scale))


def price_of_moving(
    us: Float[Array, "T nu"], gradient: Float[Array, "T nu"]
) -> Float[Array, "T nu"]:
    """Return a curvature (T, nu) for controls of a model that has none, in its units.

    With the largest |gradient| of each control over its largest value, a step down the gradient is
    about as large as the controls are (as 1, where they are all zero).
    """
    size = jnp.max(jnp.abs(us), axis=0)
    price = jnp.max(jnp.abs(gradient), axis=0) / jnp.where(size > 0, size, 1.0)
    return jnp.broadcast_to(price, us.shape)


def metric(
    curvature: Float[Array, "T nu"], otherwise: Float[Array, "T nu"]
) -> Float[Array, "T nu"]:
    """Return the positive diagonal (T, nu) in which gradients are measured.

    It is |curvature|, or `otherwise` where the whole model has none.
    """
    D = jnp.abs(curvature)
    D = jnp.where(D.max() > jnp.finfo(D.dtype).eps * otherwise.max(), D, otherwise)
    # Where a control hardly matters, its gradient over its curvature is round-off.
    D = jnp.maximum(D, jnp.finfo(D.dtype).eps ** 0.6 * D.mean())
    return jnp.where(D > 0, D, 1.0)


def rounding(
    model: LocalModel, xs: Float[Array, "T+1 nx"], cost: Float[Array, ""]
) -> Float[Array, ""]:
    """Return what of a change of the cost is lost in rounding, shape ().

    10 eps of the cost, and what it changes with a last state that is known to eps sqrt(T) times
    its largest value.

    Arguments: the model at xs (T+1, nx), and its cost.
    """
    eps = jnp.finfo(xs.dtype).eps
    dx = eps * jnp.sqrt(xs.shape[0]) * jnp.max(jnp.abs(xs), axis=0)
    return 10 * eps * jnp.abs(cost) + jnp.max(jnp.abs(model.vx) * dx)


def expected_reduction(sweep: Sweep) -> Float[Array, ""]:
    """Return by how much a full step along the law lowers the cost on its model, shape ()."""
    return -(sweep.linear + sweep.quadratic)


def converged(
    status: Status,
    sweep: Sweep,
    us: Float[Array, "T nu"],
    cost: Float[Array, ""],
    scale: Float[Array, ""],
    gradient: Float[Array, ""],
    round_off: Float[Array, ""],
    *,
    sure: Bool[Array, ""],
    first: Bool[Array, ""],
    tolerances: Tolerances,
) -> Status:
    """Return the success, or NONFINITE_DERIVATIVE, that a sweep proves; `status` where neither.

    Arguments:
        sweep: the law at the iterate us (T, nu), whose cost is compared with `scale`.
        gradient: the relative projected gradient there.
        round_off: what of a change of the cost is lost in rounding.
        sure: whether the sweep was all but undamped. first: whether no step was accepted so far.
        tolerances: those of the solver.
    """
    gradient_tol, cost_tol, step_tol = tolerances.resolve(cost.dtype)
    expected = expected_reduction(sweep)
    relative = expected / scale
    largest = jnp.max(jnp.abs(us))
    sure = sweep.ok & sweep.settled & sure
    # At the optimum the expectation is round-off itself, of either sign.
    stationary = sure & (gradient <= gradient_tol) & (expected >= -round_off)
    at_round_off = expected <= round_off
    # Nothing to gain, and no curvature either: the cost does not depend on the controls.
    flat = (sweep.gradient == 0).all() & (sweep.curvature == 0).all() & first
    # In float32 the states' own rounding may keep the gradient of a stiff problem from falling.
    coarse = sure & (cost.dtype != jnp.float64) & (jnp.abs(expected) <= round_off)
    for condition, reason, index in (
        (coarse & ~first, Reason.CONVERGED_ROUND_OFF, -1),
        (stationary & (jnp.max(jnp.abs(sweep.k)) <= step_tol * largest),
         Reason.CONVERGED_STEP, -1),
        (stationary & (relative <= cost_tol), Reason.CONVERGED_COST, -1),
        (stationary & at_round_off, Reason.CONVERGED_GRADIENT, -1),
        ((stationary & at_round_off & first) | flat, Reason.STATIONARY_START, -1),
        (sweep.nonfinite >= 0, Reason.NONFINITE_DERIVATIVE, sweep.nonfinite),
    ):  # fmt: skip
        status = _status.where(condition, Status.of(reason, index), status)
    return status


def start_status(
    problem: Problem, xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"], status: Status
) -> Status:
    """Tell where the starting trajectory is not finite; `status` where it is.

    Arguments: the trajectory xs (T+1, nx), us (T, nu).
    """
    for bad_at, reason in (
        (first_nonfinite(problem.stage_costs(xs, us)), Reason.NONFINITE_COST),
        (first_nonfinite(xs) - 1, Reason.NONFINITE_DYNAMICS),
    ):
        status = _status.where(bad_at >= 0, Status.of(reason, bad_at), status)
    return status
