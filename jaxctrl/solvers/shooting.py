"""The iteration that ILQR shares with its relatives: expand, sweep, search along the law."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import _status
from .._controller import clip
from .._problem import Problem
from .._status import Reason, Status, first_nonfinite
from .._types import Bounds, LocalModel
from ..linear import Sweep, box_lqr, costates, lqr, pushed
from .line_search import Trial, backtrack

LAM_FIRST, LAM_MIN, LAM_MAX = 1e-6, 1e-9, 1e10
LAM_FACTOR = 1.6
LAM_SURE = 1e-3
LONG, SHORT = 0.5, 0.07


class Tolerances(eqx.Module):
    """When an iterate counts as converged; None takes the default of the dtype at hand.

    Attributes:
        gradient: bound on the relative projected gradient (see `projected_gradient`), which every
            success satisfies but float32's `CONVERGED_ROUND_OFF`; 20 eps^0.4, 1.1e-5 in float64
            and 0.03 in float32.
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
    """An iterate with its expansion, its law and what is known of its quality.

    Attributes:
        xs, us, cost: the trajectory, (T+1, nx) and (T, nu), and its cost.
        start_cost: the cost at the very start, the floor of the scale of costs.
        model, sweep: the expansion there and the law computed from it.
        side: which controls the law holds at a bound: -1 lower, 1 upper, 0 free.
        measured: whether these have been computed at all.
        gradient: the relative projected gradient.
        round_off: what of a change of the cost is lost in rounding.
        lam, factor: relative regularisation and the factor by which it last changed.
        fraction: of the last law, by which the iterate was reached; 0 when it was rejected.
        num_accepted: number of steps accepted so far.
        status: `RUNNING`, or why the iteration ends.
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    cost: Float[Array, ""]
    start_cost: Float[Array, ""]
    model: LocalModel
    sweep: Sweep
    side: Float[Array, "T nu"]
    measured: Bool[Array, ""]
    gradient: Float[Array, ""]
    round_off: Float[Array, ""]
    lam: Float[Array, ""]
    factor: Float[Array, ""]
    fraction: Float[Array, ""]
    num_accepted: Int[Array, ""]
    status: Status


def init(problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> ShootingState:
    """Roll out the clipped controls us (T, nu) from x0 (nx,) and judge the start."""
    bounds = problem.bounds
    status = Status.of(Reason.RUNNING)
    if bounds is not None:
        crossed = (bounds[0] > bounds[1]).any(axis=1)
        infeasible = Status.of(Reason.INFEASIBLE_BOUNDS, jnp.argmax(crossed))
        status = _status.where(crossed.any(), infeasible, status)
    us = clip(us, bounds)
    xs = problem.rollout(x0, us)
    costs = problem.stage_costs(xs, us)
    leaves = jax.tree.leaves(eqx.filter((problem.plant, problem.cost, problem.dt), eqx.is_array))
    finite = [jnp.isfinite(leaf).all() for leaf in [*leaves, x0, us]]
    for bad_at, reason in (
        (first_nonfinite(costs), Reason.NONFINITE_COST),
        (first_nonfinite(xs) - 1, Reason.NONFINITE_DYNAMICS),
        (jnp.where(jnp.stack(finite).all(), -1, 0), Reason.NONFINITE_INPUT),
    ):
        index = -1 if reason == Reason.NONFINITE_INPUT else bad_at
        status = _status.where(bad_at >= 0, Status.of(reason, index), status)
    num_steps, nx, nu, dtype = problem.num_steps, x0.size, us.shape[1], us.dtype
    zeros = jnp.zeros
    model = LocalModel(
        *(zeros((num_steps, *shape), dtype) for shape in _block_shapes(nx, nu)),
        vx=zeros(nx, dtype),
        vxx=zeros((nx, nx), dtype),
    )
    per_control = zeros(us.shape, dtype)
    sweep = Sweep(
        k=per_control,
        K=zeros((*us.shape, nx), dtype),
        free=zeros(us.shape, bool),
        curvature=per_control,
        linear=zeros((), dtype),
        quadratic=zeros((), dtype),
        ok=jnp.array(False),
        failed=jnp.array(-1, jnp.int32),
        settled=jnp.array(False),
    )
    cost = jnp.sum(costs)
    return ShootingState(
        xs=xs,
        us=us,
        cost=cost,
        start_cost=cost,
        model=model,
        sweep=sweep,
        side=per_control,
        measured=jnp.array(False),
        gradient=jnp.full((), jnp.nan, dtype),
        round_off=zeros((), dtype),
        lam=zeros((), dtype),
        factor=jnp.ones((), dtype),
        fraction=zeros((), dtype),
        num_accepted=jnp.array(0),
        status=status,
    )


def _block_shapes(nx: int, nu: int):
    return ((nx, nx), (nx, nu), (nx,), (nu,), (nx, nx), (nu, nx), (nu, nu))


def step(
    problem: Problem,
    state: ShootingState,
    expand: Callable[[Problem, Array, Array], LocalModel],
    tolerances: Tolerances,
) -> ShootingState:
    """Search along the present law, then expand and sweep where that led.

    After a rejection only the sweep is done again, with more regularisation; the derivatives
    still hold.
    """
    bounds = problem.bounds
    wanted = state.measured & state.sweep.ok & state.status.is_(Reason.RUNNING)
    trial = backtrack(
        problem, state.xs, state.us, state.cost, state.sweep, bounds, state.round_off, wanted
    )
    lam, factor = _schedule(state, trial)
    moved = trial.accepted | ~state.measured
    model = jax.lax.cond(moved, lambda: expand(problem, trial.xs, trial.us), lambda: state.model)
    _, gradient = costates(model)
    sweep, side = _law(model, gradient, state, lam, trial.us, bounds)
    scale = cost_scale(trial.cost, state.start_cost)
    new = ShootingState(
        xs=trial.xs,
        us=trial.us,
        cost=trial.cost,
        start_cost=state.start_cost,
        model=model,
        sweep=sweep,
        side=side,
        measured=jnp.array(True),
        gradient=projected_gradient(trial.us, gradient, sweep.curvature, scale, bounds),
        round_off=rounding(model, trial.xs, trial.cost),
        lam=lam,
        factor=factor,
        fraction=trial.fraction,
        num_accepted=state.num_accepted + trial.accepted,
        status=state.status,
    )
    return eqx.tree_at(lambda s: s.status, new, _judge(state, new, tolerances))


def _law(model, gradient, state: ShootingState, lam, us, bounds) -> tuple[Sweep, Array]:
    """Sweep through the model, damped by lambda times the last sweep's curvatures."""
    curvature = jnp.abs(state.sweep.curvature)
    damping = lam * jnp.maximum(curvature, 1e-3 * curvature.mean())
    if bounds is None:
        return lqr(model, damping), state.side
    lower, upper = bounds[0] - us, bounds[1] - us
    # The last held set is the best guess, except at the start and where the sets cycled.
    guess = jnp.where(state.sweep.settled, state.side, pushed(gradient, lower, upper))
    return box_lqr(model, lower, upper, damping, side=guess)


def _schedule(state: ShootingState, trial: Trial) -> tuple[Array, Array]:
    """Adapt lambda, faster each time in the same direction (Tassa, Erez & Todorov 2012).

    A long accepted step lowers it. A rejected one raises it, and so does a short one: there the
    linear model holds only nearby, and a more regular direction goes further.
    """
    good, bad = trial.fraction >= LONG, trial.fraction <= SHORT
    down = jnp.minimum(1 / LAM_FACTOR, state.factor / LAM_FACTOR)
    up = jnp.maximum(LAM_FACTOR, state.factor * LAM_FACTOR)
    lower = state.lam * down
    lower = jnp.where(lower < LAM_MIN, 0.0, lower)
    higher = jnp.maximum(state.lam * up, LAM_FIRST)
    lam = jnp.where(good, lower, jnp.where(bad, higher, state.lam))
    factor = jnp.where(good, down, jnp.where(bad, up, 1.0))
    keep = ~state.measured
    return jnp.where(keep, state.lam, lam), jnp.where(keep, state.factor, factor)


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


def _judge(old: ShootingState, new: ShootingState, tolerances: Tolerances) -> Status:
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
    stuck = rejected & (new.lam > LAM_MAX)
    solved = old.sweep.ok & old.sweep.settled & (old.lam >= LAM_SURE)
    hopeless = solved & (-(old.sweep.linear + old.sweep.quadratic) <= old.round_off)
    finite = [jnp.isfinite(block).reshape(block.shape[0], -1) for block in new.model[:-2]]
    bad = ~jnp.concatenate(finite, axis=1).all(axis=1)
    last_bad = ~(jnp.isfinite(new.model.vx).all() & jnp.isfinite(new.model.vxx).all())
    bad_at = jnp.where(bad.any(), jnp.argmax(bad), bad.size)

    status = Status.of(Reason.RUNNING)
    for condition, reason, index in (
        (rejected & hopeless, Reason.STALLED, -1),
        (stuck & old.sweep.ok, Reason.LINE_SEARCH_FAILED, -1),
        (stuck & ~old.sweep.ok, Reason.REGULARISATION_EXHAUSTED, old.sweep.failed),
        (coarse & ~first, Reason.CONVERGED_ROUND_OFF, -1),
        (stationary & (jnp.max(jnp.abs(new.sweep.k)) <= step_tol * largest),
         Reason.CONVERGED_STEP, -1),
        (stationary & (relative <= cost_tol), Reason.CONVERGED_COST, -1),
        (stationary & at_round_off, Reason.CONVERGED_GRADIENT, -1),
        (stationary & at_round_off & first, Reason.STATIONARY_START, -1),
        (bad.any() | last_bad, Reason.NONFINITE_DERIVATIVE, bad_at),
    ):  # fmt: skip
        status = _status.where(condition, Status.of(reason, index), status)
    return _status.where(old.status.is_(Reason.RUNNING), status, old.status)
