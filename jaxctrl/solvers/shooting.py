"""The iteration that ILQR shares with its relatives: expand, sweep, search along the law."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import _status
from .._controller import clip
from .._problem import Problem
from .._solver import Found, Record
from .._status import Reason, Status
from .._types import Bounds, LocalModel
from ..linear import Sweep
from ..linear._box_lqr import box_lqr
from ..linear._engine import find_engine
from ..linear._factorised import factorise
from ..linear._sensed import settle
from ._damping import LAM_MAX, LAM_SURE, adapt
from ._judging import (
    Tolerances,
    converged,
    cost_scale,
    expected_reduction,
    input_status,
    no_sweep,
    price_of_moving,
    projected_gradient,
    rounding,
    start_status,
)
from ._minimiser import AbstractMinimiser
from ._polish import IDLE, Pair, Polish, advance, begin, failed, noise_status, proceeds
from ._rollout import rollout_law
from .line_search import Trial, search

NEAR = 1.0
"""The projected gradient at which the exact second order, where wanted, replaces Gauss-Newton's."""


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
        final: whether the gains are those of the solver's own model, undamped.
        num_accepted: number of steps accepted so far.
        status: `RUNNING`, or why the iteration ends.
        polish: how a stochastic solver gets on where costs fall no more; None for others.
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
    final: Bool[Array, ""]
    num_accepted: Int[Array, ""]
    status: Status
    polish: Polish | None


def init(
    problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"], stochastic: bool
) -> ShootingState:
    """Return the state before anything was computed; the first step rolls the controls out."""
    us, xs = clip(us, problem.bounds), jnp.broadcast_to(x0, (problem.num_steps + 1, x0.size))
    none, number = jnp.zeros_like(us), jnp.zeros((), us.dtype)
    return ShootingState(
        xs=xs,
        us=us,
        cost=jnp.full((), jnp.nan, us.dtype),
        start_cost=number,
        sweep=no_sweep(us, x0.size),
        side=jnp.full_like(none, jnp.nan),
        measured=jnp.array(False),
        gradient=jnp.full((), jnp.nan, us.dtype),
        round_off=number,
        lam=number,
        factor=jnp.ones((), us.dtype),
        fraction=number,
        second=jnp.array(False),
        final=jnp.array(False),
        num_accepted=jnp.array(0),
        status=input_status(problem, x0, us),
        polish=begin(xs, us) if stochastic else None,
    )


def step(
    problem: Problem, state: ShootingState, last: Bool[Array, ""], solver: "AbstractShooting"
) -> ShootingState:
    """Search along the present law, then expand and sweep where that led.

    The first step only rolls out the starting controls: its law is zero. The expansion is not
    kept: carrying it through the loop costs more time than the few expansions that rejections
    repeat. The `last` step sweeps the solver's own model, undamped, where the iteration has ended.
    """
    bounds = problem.bounds
    wanted = (state.sweep.ok | ~state.measured) & state.status.is_(Reason.RUNNING) & ~last
    trial = _search(problem, state, solver, wanted)
    fraction = jnp.where(state.measured, trial.fraction, 0.0)
    # Where the exact second order has led to nothing, Gauss and Newton's is tried before more
    # regularisation, and the exact one where Gauss and Newton's has no curvature at all.
    undone = state.second & (fraction == 0)
    trying = solver.second_order & state.measured & ~state.second & _bare(state)
    anew = undone | (trying & (state.fraction > 0))
    lam, factor = adapt(state.lam, state.factor, fraction, state.measured & ~anew)
    polishing = proceeds(state.polish, _vain(state, fraction), state.gradient)
    lam = jnp.where(last | polishing, 0.0, lam)
    second = solver.second_order & (((state.gradient <= NEAR) | trying) & ~undone | last)
    model = solver.expand(problem, trial.xs, trial.us, second)
    damping = lam * _marquardt(state)
    box = None if bounds is None else (bounds[0] - trial.us, bounds[1] - trial.us)
    sweep, side = solver.law(model, damping, box, state.side, state.sweep)
    start_cost = jnp.where(state.measured, state.start_cost, trial.cost)
    scale, cost = cost_scale(trial.cost, start_cost), trial.cost
    polish = state.polish
    if polish is not None:
        cost = solver.merit(problem, trial.xs, trial.us, sweep, model)  # with the new gains
        nominal = problem.total_cost(trial.xs, trial.us)
        polish = polish._replace(nominal=jnp.where(state.measured, polish.nominal, nominal))
    new = ShootingState(
        xs=trial.xs,
        us=trial.us,
        cost=cost,
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
        final=jnp.array(True),
        num_accepted=state.num_accepted + (trial.accepted & state.measured),
        status=state.status,
        polish=polish,
    )
    judged = _judge(problem, state, new, solver.tolerances)
    final = (lam == 0) & (second == solver.second_order)
    new = eqx.tree_at(lambda s: (s.status, s.final), new, (judged, final))
    if polish is not None:
        blamed = noise_status(polish, model, sweep, cost, new.status)
        blamed = _status.where(state.status.is_(Reason.RUNNING), blamed, new.status)
        new = eqx.tree_at(lambda s: s.status, new, blamed)
        new = _polished(polish, state, new, polishing)
    return _settle(state, new, last)


def _vain(state: ShootingState, fraction: Array) -> Array:
    """Tell whether a search along a law that was all but undamped has led to nothing."""
    whole = state.sweep.ok & state.sweep.settled & (state.lam <= LAM_SURE)
    return state.measured & whole & (fraction == 0)


def _polished(
    polish: Polish, old: ShootingState, new: ShootingState, proceeding: Array
) -> ShootingState:
    """Take back a step of polishing that failed, and keep the best pair."""
    vain = failed(polish, old.gradient, new.gradient)
    # A failure there is none of the iteration's.
    status = _status.where(new.status.ok, new.status, old.status)
    back = eqx.tree_at(
        lambda s: (s.fraction, s.status), old, (jnp.zeros_like(old.fraction), status)
    )
    new = jax.tree.map(lambda a, b: jnp.where(vain, a, b), back, new)
    lowered = (new.fraction > 0) & ~polish.going
    pair = Pair(new.xs, new.us, new.sweep.K, new.side, new.cost, new.gradient)
    usable = new.sweep.ok & new.sweep.settled
    after = advance(polish, proceeding, vain, lowered, pair, usable)
    stalled = new.status.is_(Reason.RUNNING) & (after.idle >= IDLE)
    status = _status.where(stalled, Status.of(Reason.STALLED_EXPECTED), new.status)
    return eqx.tree_at(lambda s: (s.polish, s.status), new, (after, status))


def _marquardt(state: ShootingState) -> Array:
    """Return the diagonal (T, nu) of which damping is a multiple, from the last sweep."""
    curvature = jnp.abs(state.sweep.curvature)
    curvature = jnp.maximum(curvature, 1e-3 * curvature.mean())
    price = price_of_moving(state.us, state.sweep.gradient)
    return jnp.where(_bare(state), price, curvature)


def _bare(state: ShootingState) -> Array:
    """Tell whether the last model had no curvature in the controls."""
    price = price_of_moving(state.us, state.sweep.gradient)
    return jnp.max(jnp.abs(state.sweep.curvature)) <= jnp.finfo(price.dtype).eps * price.max()


def _search(
    problem: Problem, state: ShootingState, solver: "AbstractShooting", wanted: Array
) -> Trial:
    """Search along the state's law."""
    bounds, sweep, side = problem.bounds, state.sweep, state.side
    none = jnp.zeros((), state.cost.dtype)
    part = 1.0 if state.polish is None else state.polish.part

    def trial_of(fraction):
        k = part * fraction * sweep.k
        # A whole step ends on the bounds that its law holds; what is at one already stays there.
        held = jnp.where((part * fraction == 1) & ~jnp.isnan(side), side, 0.0)
        xs, us = rollout_law(problem, state.xs, state.us, k, sweep.K, bounds, held)
        return xs, us, solver.merit(problem, xs, us, sweep)

    def expected_of(fraction):
        return -(fraction * sweep.linear + fraction**2 * sweep.quadratic)

    nominal = Trial(state.xs, state.us, state.cost, none, jnp.array(False))
    forced = ~state.measured if state.polish is None else ~state.measured | state.polish.going
    trial = search(nominal, trial_of, expected_of, state.round_off, wanted=wanted, forced=forced)
    return trial._replace(fraction=part * trial.fraction)


def _settle(state: ShootingState, new: ShootingState, last: Array) -> ShootingState:
    """Take over the gains alone from a last step, and those only if its model is convex."""
    good = new.sweep.ok & new.sweep.settled & (new.sweep.nonfinite < 0)
    gains = jnp.where(good, new.sweep.K, state.sweep.K)
    side = jnp.where(good, new.side, state.side)
    settled = eqx.tree_at(
        lambda s: (s.sweep.K, s.side, s.final), state, (gains, side, jnp.array(True))
    )
    return jax.tree.map(lambda a, b: jnp.where(last, a, b), settled, new)


def _judge(problem, old: ShootingState, new: ShootingState, tolerances: Tolerances) -> Status:
    """Say why to stop, or RUNNING."""
    rejected = old.measured & (new.fraction == 0)
    vain = rejected & old.sweep.ok & old.sweep.settled
    tolerance = tolerances.resolve(new.cost.dtype)[0]
    # No part of an undamped step lowers the cost, as near a goal whose cost is a difference of
    # large numbers: the gradient is within its tolerance, and costs can tell no more.
    at_rest = vain & (old.lam <= LAM_SURE) & (old.gradient <= tolerance)
    rejected &= ~old.second
    stuck = rejected & (new.lam > LAM_MAX)
    solved = old.measured & ~(old.second & (new.fraction == 0)) & old.sweep.ok & old.sweep.settled
    hopeless = solved & (expected_reduction(old.sweep) <= old.round_off)
    hopeless &= jnp.where(rejected, old.lam >= LAM_SURE, new.gradient >= old.gradient)
    hopeless &= new.gradient > tolerance
    bottomless = old.measured & (
        new.cost < -jnp.abs(old.start_cost) / jnp.finfo(new.cost.dtype).eps
    )

    status = Status.of(Reason.RUNNING)
    failed_search = Reason.LINE_SEARCH_FAILED if old.polish is None else Reason.STALLED_EXPECTED
    for condition, reason, index in (
        (hopeless, Reason.STALLED, -1),
        (stuck & old.sweep.ok, failed_search, -1),
        (stuck & ~old.sweep.ok, Reason.REGULARISATION_EXHAUSTED, old.sweep.failed),
        (bottomless & (old.start_cost != 0), Reason.UNBOUNDED_COST, -1),
        (at_rest, Reason.CONVERGED_GRADIENT, -1),
    ):
        status = _status.where(condition, Status.of(reason, index), status)
    status = converged(
        status, new.sweep, new.us, new.cost, cost_scale(new.cost, new.start_cost),
        new.gradient, new.round_off,
        sure=new.lam <= LAM_SURE, first=new.num_accepted == 0, tolerances=tolerances,
    )  # fmt: skip
    start = jax.lax.cond(
        old.measured, lambda: status, lambda: start_status(problem, new.xs, new.us, status)
    )
    return _status.where(old.status.is_(Reason.RUNNING), start, old.status)


class AbstractShooting(AbstractMinimiser):
    """A solver of this kind: what it expands, the law it makes of that, and what must fall."""

    @property
    @abc.abstractmethod
    def second_order(self) -> bool:
        """Whether it has a second model, exact to second order, which it takes near the optimum."""

    @abc.abstractmethod
    def expand(
        self,
        problem: Problem,
        xs: Float[Array, "T+1 nx"],
        us: Float[Array, "T nu"],
        near: bool | Bool[Array, ""],
    ) -> LocalModel:
        """Return the model around xs (T+1, nx), us (T, nu), the exact one if `near` the optimum."""

    @abc.abstractmethod
    def law(
        self,
        model: LocalModel,
        damping: Float[Array, "T nu"],
        box: Bounds | None,
        guess: Float[Array, "T nu"],
        last: Sweep,
    ) -> tuple[Sweep, Float[Array, "T nu"]]:
        """Return the law of the least cost on a model, and which controls it holds at bounds.

        Arguments: damping (T, nu); bounds on du, each (T, nu), or None; a guess of the answer's
        second part, `side` of `Found`; and the law of the iterate before.
        """

    @abc.abstractmethod
    def merit(
        self,
        problem: Problem,
        xs: Float[Array, "T+1 nx"],
        us: Float[Array, "T nu"],
        law: Sweep,
        model: LocalModel | None = None,
    ) -> Float[Array, ""]:
        """Return what each step must lower, shape (), for xs (T+1, nx), us (T, nu) and a law.

        `model` is the expansion there, where it is known already.
        """

    def init(self, problem, x0, us):
        """Return the state before anything was computed, from us (T, nu) and x0 (nx,)."""
        return init(problem, x0, us, self.stochastic)

    def step(self, problem, state, last=False):
        """Search along the law, then expand and sweep anew; arrays keep their shapes."""
        return step(problem, state, jnp.asarray(last), self)

    def record(self, state):
        """Return cost, projected gradient, accepted fraction and lambda, each of shape ()."""
        return Record(state.cost, state.gradient, state.fraction, state.lam)

    def final(self, state):
        """Tell whether the gains are those of the solver's own model, undamped; shape ()."""
        return state.final

    def found(self, problem, state):
        """Return the last trajectory, xs (T+1, nx) and us (T, nu), and the gains around it.

        Without noise the policy reproduces that trajectory: the step that the sweep would take
        next is not part of it. Of a stochastic solver that did not come to rest, the best pair met.
        """
        last = Found(state.xs, state.us, state.sweep.K, state.side, state.gradient)
        if state.polish is None:
            return last
        best = state.polish.best
        kept = Found(best.xs, best.us, best.K, best.side, best.gradient)
        # At rest by the usual measure it is what was looked for, if a tighter one was asked for.
        rest = state.gradient <= Tolerances().resolve(state.cost.dtype)[0]
        rest &= state.sweep.ok & state.sweep.settled
        worse = ~state.status.ok & ~rest & jnp.isfinite(best.cost)
        return jax.tree.map(lambda a, b: jnp.where(worse, a, b), kept, last)

    def known(self, problem, xs, us, side):
        """Return the model of a known state around xs (T+1, nx), us (T, nu), for its derivatives.

        With a sensor, what is sensed is priced in. `side` (T, nu) tells which controls are held,
        where not 0.
        """
        model = self.expand(problem, xs, us, True)
        return model if model.sensing is None else settle(model, side)

    def gains(self, problem, xs, us, side):
        """Return the gains (T, nu, nx) of the model around xs (T+1, nx), us (T, nu)."""
        return factorise(self.known(problem, xs, us, side), side == 0).K


def box_or_free_law(
    model: LocalModel,
    damping: Float[Array, "T nu"],
    box: Bounds | None,
    guess: Float[Array, "T nu"],
    engine: str,
) -> tuple[Sweep, Float[Array, "T nu"]]:
    """Return the exact minimiser of the model, with its controls in a box or free.

    Arguments and result as of `AbstractShooting.law`; `engine` sweeps.
    """
    if box is None:
        return find_engine(engine).lqr(model, damping), jnp.zeros_like(damping)
    return box_lqr(model, *box, damping, side=guess, engine=engine)
