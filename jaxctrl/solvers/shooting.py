"""The iteration that ILQR shares with its relatives: expand, sweep, search along the law."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import _status
from .._controller import AffinePolicy, clip
from .._local_model import expand
from .._problem import Problem
from .._status import Reason, Status, first_nonfinite
from .._types import Bounds, LocalModel
from ..linear import Sweep, box_lqr, lqr
from ._abstract import AbstractSolver, Record
from .line_search import Trial, search

LAM_FIRST, LAM_MIN, LAM_MAX = 1e-6, 1e-9, 1e10
LAM_FACTOR = 1.6
LAM_SURE = 1e-3
LONG, SHORT = 0.5, 0.07
NEAR = 1.0
"""The projected gradient at which the exact second order, where wanted, replaces Gauss-Newton's."""


class Tolerances(eqx.Module):
    """When an iterate counts as converged; None takes the default of the dtype at hand.

    Attributes:
        gradient: bound on the relative projected gradient, which every success satisfies but
            float32's `CONVERGED_ROUND_OFF`; 20 eps^0.4, 1.1e-5 in float64 and 0.03 in float32. It
            is sqrt(sum D p^2 / |J|), with D the |diagonal of Q_uu|, g the gradient of the cost J
            in the controls and p = u - clip(u - g/D) over all times and controls: free of units,
            and its square twice the relative reduction of J that steps -g/D expect.
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


class ShootingState(eqx.Module):
    """An iterate with the law computed there and what is known of its quality.

    Attributes:
        xs, us, cost: the trajectory, (T+1, nx) and (T, nu), and its cost.
        start_cost: the cost at the very start, the floor of the scale of costs.
        sweep: the law computed from the expansion there.
        side: which controls to hold first at a bound: -1 lower, 1 upper, 0 none, NaN unknown.
        measured: whether these have been computed at all.
        gradient: the relative projected gradient.
        round_off: what of a change of the cost is lost in rounding.
        lam, factor: relative regularisation and the factor by which it last changed.
        fraction: of the last law, by which the iterate was reached; 0 when it was rejected.
        second: whether the law comes from the exact second order.
        num_accepted: number of steps accepted so far.
        status: `RUNNING`, or why the iteration ends.
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    cost: Float[Array, ""]
    start_cost: Float[Array, ""]
    sweep: Sweep
    side: Float[Array, "T nu"]
    measured: Bool[Array, ""]
    gradient: Float[Array, ""]
    round_off: Float[Array, ""]
    lam: Float[Array, ""]
    factor: Float[Array, ""]
    fraction: Float[Array, ""]
    second: Bool[Array, ""]
    num_accepted: Int[Array, ""]
    status: Status


def init(problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> ShootingState:
    """Return the state before anything was computed; the first step rolls the controls out."""
    bounds = problem.bounds
    status = Status.of(Reason.RUNNING)
    if bounds is not None:
        crossed = (bounds[0] > bounds[1]).any(axis=1)
        infeasible = Status.of(Reason.INFEASIBLE_BOUNDS, jnp.argmax(crossed))
        status = _status.where(crossed.any(), infeasible, status)
    # Bounds alone may be infinite.
    plant = eqx.tree_at(
        lambda p: p.control_bounds, problem.plant, None, is_leaf=lambda leaf: leaf is None
    )
    inputs = eqx.filter((plant, problem.cost, problem.dt, x0, us), eqx.is_inexact_array)
    finite = jnp.isfinite(jax.flatten_util.ravel_pytree(inputs)[0]).all()
    if bounds is not None:
        finite &= ~jnp.isnan(bounds[0]).any() & ~jnp.isnan(bounds[1]).any()
    status = _status.where(finite, status, Status.of(Reason.NONFINITE_INPUT))
    dtype = us.dtype
    none, number = jnp.zeros(us.shape, dtype), jnp.zeros((), dtype)
    whole = jnp.array(-1, jnp.int32)
    sweep = Sweep(
        k=none,
        K=jnp.zeros((*us.shape, x0.size), dtype),
        gradient=none,
        curvature=none,
        linear=number,
        quadratic=number,
        ok=jnp.array(False),
        failed=whole,
        nonfinite=whole,
        settled=jnp.array(False),
    )
    return ShootingState(
        xs=jnp.broadcast_to(x0, (problem.num_steps + 1, x0.size)),
        us=clip(us, bounds),
        cost=jnp.full((), jnp.nan, dtype),
        start_cost=number,
        sweep=sweep,
        side=jnp.full_like(none, jnp.nan),
        measured=jnp.array(False),
        gradient=jnp.full((), jnp.nan, dtype),
        round_off=number,
        lam=number,
        factor=jnp.ones((), dtype),
        fraction=number,
        second=jnp.array(False),
        num_accepted=jnp.array(0),
        status=status,
    )


def step(problem: Problem, state: ShootingState, solver: "AbstractShooting") -> ShootingState:
    """Search along the present law, then expand and sweep where that led.

    The first step only rolls out the starting controls: its law is zero. The expansion is not
    kept: carrying it through the loop costs more time than the few expansions that rejections
    repeat.
    """
    bounds = problem.bounds
    zero = jnp.zeros((), state.cost.dtype)
    nominal = Trial(state.xs, state.us, state.cost, zero, jnp.array(False))
    trial = search(
        problem, nominal, state.sweep, bounds, state.round_off,
        wanted=(state.sweep.ok | ~state.measured) & state.status.is_(Reason.RUNNING),
        forced=~state.measured,
    )  # fmt: skip
    fraction = jnp.where(state.measured, trial.fraction, 0.0)
    # Where the exact second order has led to nothing, Gauss and Newton's is tried before more
    # regularisation.
    undone = state.second & (fraction == 0)
    lam, factor = _schedule(state, fraction, state.measured & ~undone)
    second = solver.second_order & (state.gradient <= NEAR) & ~undone
    model = expand(
        problem, trial.xs, trial.us, second_order=second if solver.second_order else False
    )
    sweep, side = _law(model, state, lam, trial.us, bounds)
    start_cost = jnp.where(state.measured, state.start_cost, trial.cost)
    scale = cost_scale(trial.cost, start_cost)
    new = ShootingState(
        xs=trial.xs,
        us=trial.us,
        cost=trial.cost,
        start_cost=start_cost,
        sweep=sweep,
        side=side,
        measured=jnp.array(True),
        gradient=projected_gradient(trial.us, sweep.gradient, sweep.curvature, scale, bounds),
        round_off=rounding(model, trial.xs, trial.cost),
        lam=lam,
        factor=factor,
        fraction=fraction,
        second=second,
        num_accepted=state.num_accepted + (trial.accepted & state.measured),
        status=state.status,
    )
    return eqx.tree_at(lambda s: s.status, new, _judge(problem, state, new, solver.tolerances))


def _law(model, state: ShootingState, lam, us, bounds) -> tuple[Sweep, Array]:
    """Sweep through the model, damped by lambda times the last sweep's curvatures."""
    curvature = jnp.abs(state.sweep.curvature)
    damping = lam * jnp.maximum(curvature, 1e-3 * curvature.mean())
    if bounds is None:
        return lqr(model, damping), state.side
    lower, upper = bounds[0] - us, bounds[1] - us
    return box_lqr(model, lower, upper, damping, side=state.side)


def _schedule(state: ShootingState, fraction: Array, wanted: Array) -> tuple[Array, Array]:
    """Adapt lambda, if wanted, faster each time in the same direction (Tassa et al. 2012).

    A long accepted step lowers it. A rejected one raises it, and so does a short one: there the
    linear model holds only nearby, and a more regular direction goes further.
    """
    good, bad = fraction >= LONG, fraction <= SHORT
    down = jnp.minimum(1 / LAM_FACTOR, state.factor / LAM_FACTOR)
    up = jnp.maximum(LAM_FACTOR, state.factor * LAM_FACTOR)
    lower = state.lam * down
    lower = jnp.where(lower < LAM_MIN, 0.0, lower)
    higher = jnp.maximum(state.lam * up, LAM_FIRST)
    lam = jnp.where(good, lower, jnp.where(bad, higher, state.lam))
    factor = jnp.where(good, down, jnp.where(bad, up, 1.0))
    return jnp.where(wanted, lam, state.lam), jnp.where(wanted, factor, state.factor)


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
    D = _metric(curvature)
    p = us - clip(us - gradient / D, bounds)
    return jnp.sqrt(jnp.sum(D * p * p / scale))


def _metric(curvature: Float[Array, "T nu"]) -> Float[Array, "T nu"]:
    """Return the positive diagonal in which gradients are measured."""
    D = jnp.abs(curvature)
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


def _judge(problem, old: ShootingState, new: ShootingState, tolerances: Tolerances) -> Status:
    """Say why to stop, or RUNNING."""
    gradient_tol, cost_tol, step_tol = tolerances.resolve(new.cost.dtype)
    expected = -(new.sweep.linear + new.sweep.quadratic)
    relative = expected / cost_scale(new.cost, new.start_cost)
    largest = jnp.max(jnp.abs(new.us))
    sure = new.sweep.ok & new.sweep.settled & (new.lam <= LAM_SURE)
    stationary = sure & (new.gradient <= gradient_tol) & (expected >= 0)
    at_round_off = expected <= new.round_off
    # In float32 the states' own rounding may keep the gradient of a stiff problem from falling.
    coarse = sure & (new.cost.dtype != jnp.float64) & (jnp.abs(expected) <= new.round_off)
    first = new.num_accepted == 0
    rejected = old.measured & (new.fraction == 0)
    rejected &= ~old.second
    stuck = rejected & (new.lam > LAM_MAX)
    solved = old.measured & ~(old.second & (new.fraction == 0)) & old.sweep.ok & old.sweep.settled
    hopeless = solved & (-(old.sweep.linear + old.sweep.quadratic) <= old.round_off)
    hopeless &= jnp.where(rejected, old.lam >= LAM_SURE, new.gradient >= old.gradient)
    bad = new.sweep.nonfinite >= 0

    status = Status.of(Reason.RUNNING)
    for condition, reason, index in (
        (hopeless, Reason.STALLED, -1),
        (stuck & old.sweep.ok, Reason.LINE_SEARCH_FAILED, -1),
        (stuck & ~old.sweep.ok, Reason.REGULARISATION_EXHAUSTED, old.sweep.failed),
        (coarse & ~first, Reason.CONVERGED_ROUND_OFF, -1),
        (stationary & (jnp.max(jnp.abs(new.sweep.k)) <= step_tol * largest),
         Reason.CONVERGED_STEP, -1),
        (stationary & (relative <= cost_tol), Reason.CONVERGED_COST, -1),
        (stationary & at_round_off, Reason.CONVERGED_GRADIENT, -1),
        (stationary & at_round_off & first, Reason.STATIONARY_START, -1),
        (bad, Reason.NONFINITE_DERIVATIVE, new.sweep.nonfinite),
    ):  # fmt: skip
        status = _status.where(condition, Status.of(reason, index), status)
    start = jax.lax.cond(old.measured, lambda: status, lambda: _judge_start(problem, new, status))
    return _status.where(old.status.is_(Reason.RUNNING), start, old.status)


def _judge_start(problem: Problem, new: ShootingState, status: Status) -> Status:
    """Tell where the starting trajectory is not finite; `status` where it is."""
    for bad_at, reason in (
        (first_nonfinite(problem.stage_costs(new.xs, new.us)), Reason.NONFINITE_COST),
        (first_nonfinite(new.xs) - 1, Reason.NONFINITE_DYNAMICS),
    ):
        status = _status.where(bad_at >= 0, Status.of(reason, bad_at), status)
    return status


class AbstractShooting(AbstractSolver):
    """A solver of this kind: it says when it has converged, and what order its model is of.

    Attributes:
        second_order: whether the model has the second derivatives of the dynamics.
    """

    second_order: eqx.AbstractClassVar[bool]
    gradient_tolerance: eqx.AbstractVar[float | None]
    cost_tolerance: eqx.AbstractVar[float | None]
    step_tolerance: eqx.AbstractVar[float | None]

    @property
    def tolerances(self) -> Tolerances:
        """The three tolerances together."""
        return Tolerances(self.gradient_tolerance, self.cost_tolerance, self.step_tolerance)

    def init(self, problem, x0, us):
        """Return the state before anything was computed, from us (T, nu) and x0 (nx,)."""
        return init(problem, x0, us)

    def step(self, problem, state):
        """Search along the law, then expand and sweep anew; arrays keep their shapes."""
        return step(problem, state, self)

    def status(self, state):
        """Return why the iteration ends, or `RUNNING`; shape ()."""
        return state.status

    def record(self, state):
        """Return cost, projected gradient, accepted fraction and lambda, each of shape ()."""
        return Record(state.cost, state.gradient, state.fraction, state.lam)

    def near(self, state):
        """Tell whether the gradient is within 100 times its tolerance, shape ()."""
        return state.gradient <= 100 * self.tolerances.resolve(state.cost.dtype)[0]

    def policy(self, problem, state):
        """Return the last gains around the last trajectory, xs (T+1, nx) and us (T, nu).

        Without noise the policy reproduces that trajectory: the step that the sweep would take
        next is not part of it.
        """
        k = jnp.zeros_like(state.us)
        return AffinePolicy(state.xs, state.us, k, state.sweep.K, problem.bounds)
