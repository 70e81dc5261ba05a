"""The iteration that the gradient methods share: a direction, a line search, and an honest end.

The gradient g = dJ/du is that of the roll-out's cost by reverse mode: the costates run backwards.
Each control is scaled by one number for all times, the geometric mean of its D = |Q_uu| in the
last Riccati sweep, so that neither the cost's unit nor those of the controls matter. With bounds
the search follows the arc u(a) = clip(u + a d), in which controls that the gradient pushes against
their bound are held (Bertsekas 1982, two-metric projection).

A sweep is made at the start, and wherever the gradient in the metric of the last one has fallen
enough to hope for convergence; it renews D and decides by the same tests as `ILQR`'s.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from .. import _status
from .._controller import clip
from .._jacobian import NO_REVERSE, reversible
from .._local_model import expand
from .._problem import Problem
from .._solver import Found, Record
from .._status import Reason, Status
from .._types import Bounds
from ..linear._box_lqr import box_lqr
from ..linear._factorised import factorise
from ..linear._riccati import Sweep, lqr
from ._judging import (
    Tolerances,
    converged,
    cost_scale,
    expected_reduction,
    input_status,
    metric,
    no_sweep,
    price_of_moving,
    projected_gradient,
    rounding,
    start_status,
)
from ._minimiser import AbstractMinimiser

TRIALS = 30
"""How many steps a line search may try."""


class Point(NamedTuple):
    """What a direction is made of.

    Attributes:
        us: the controls (T, nu). gradient: that of the cost there, (T, nu).
        metric: by how much each control counts in a direction, positive, (nu,).
        free: which controls may move, (T, nu).
        scale: the |J| with which changes of the cost are compared.
    """

    us: Float[Array, "T nu"]
    gradient: Float[Array, "T nu"]
    metric: Float[Array, " nu"]
    free: Bool[Array, "T nu"]
    scale: Float[Array, ""]


class Measured(NamedTuple):
    """A Riccati sweep at an iterate, what it holds, the cost and the rounding of its changes."""

    cost: Float[Array, ""]
    sweep: Sweep
    side: Float[Array, "T nu"]
    round_off: Float[Array, ""]
    start: Status


class DescentState(eqx.Module):
    """An iterate, its gradient, and what the method remembers of earlier ones.

    Attributes:
        x0, us, cost: the start (nx,) and the controls (T, nu), and their cost.
        steepness: the gradient of the cost in the controls, (T, nu).
        start_cost: the cost at the very start, the floor of the scale of costs.
        memory: the solver's own.
        fresh: whether the memory is empty: the next direction is that of steepest descent.
        look: the last sweep.
        gradient: the relative projected gradient.
        level: the gradient at which to sweep next.
        length: the step along the last direction; 0 when nothing was accepted.
        predicted: the change of the cost that the last accepted step predicted to first order.
        trials: how many gradients the last line search took.
        measured: whether anything has been computed at all.
        num_accepted: number of steps accepted so far.
        status: `RUNNING`, or why the iteration ends.
    """

    x0: Float[Array, " nx"]
    us: Float[Array, "T nu"]
    cost: Float[Array, ""]
    steepness: Float[Array, "T nu"]
    start_cost: Float[Array, ""]
    memory: Any
    fresh: Bool[Array, ""]
    look: Measured
    gradient: Float[Array, ""]
    level: Float[Array, ""]
    length: Float[Array, ""]
    predicted: Float[Array, ""]
    trials: Int[Array, ""]
    measured: Bool[Array, ""]
    num_accepted: Int[Array, ""]
    status: Status


class Step(NamedTuple):
    """Where a line search led, and how: names as in `DescentState`."""

    us: Float[Array, "T nu"]
    cost: Float[Array, ""]
    steepness: Float[Array, "T nu"]
    length: Float[Array, ""]
    predicted: Float[Array, ""]
    trials: Int[Array, ""]
    memory: Any


def _project(us: Array, bounds: Bounds | None) -> Array:
    """Clip, with the derivative 1 at a bound itself, where `jnp.clip` has 1/2."""
    if bounds is None:
        return us
    lower, upper = bounds
    return jnp.where(us < lower, lower, jnp.where(us > upper, upper, us))


def _movable(us: Array, slope: Array, bounds: Bounds | None) -> Array:
    """Return which controls are not pushed out of a bound by a step against `slope`."""
    if bounds is None:
        return jnp.ones(us.shape, bool)
    return ~(((us <= bounds[0]) & (slope > 0)) | ((us >= bounds[1]) & (slope < 0)))


def _search(problem: Problem, state: DescentState, solver: "AbstractDescent") -> Step:
    """Search along the projected arc of a direction for a step of Wolfe's strong conditions.

    A trial that is not finite is rejected by the line search like one that is too long. What comes
    out of it is rejected if the cost rises, but for rounding, or if it is not finite.
    """
    bounds, g = problem.bounds, state.steepness
    # One number for all times: the Hessian is often a multiple of one and few other directions,
    # which a scale for each time would hide.
    weight = jnp.exp(
        jnp.mean(jnp.log(metric(state.look.sweep.curvature, price_of_moving(state.us, g))), axis=0)
    )
    scale = cost_scale(state.cost, state.start_cost)
    point = Point(state.us, g, weight, _movable(state.us, g, bounds), scale)
    direction, first, memory = solver._direction(point, state)
    d = jnp.where(point.free & _movable(state.us, -direction, bounds), direction, 0.0)
    first = jnp.minimum(first, _longest(scale, jnp.sum(g * d)))

    def value(params):
        # The gradient in `us` gives the slope along the arc; that in `shift`, which is and stays
        # zero, is the cost's own, held controls included.
        us = _project(params["us"], bounds) + params["shift"]
        xs = problem.rollout(state.x0, us)
        return jnp.where(jnp.isfinite(xs).all(), problem.total_cost(xs, us), jnp.nan)

    none = jnp.zeros_like(d)
    # Under vmap, a lane that has ended must not keep the others waiting.
    trials = jnp.where(state.status.is_(Reason.RUNNING), TRIALS, 1)
    # Where costs can no longer tell, slopes alone decide (Hager & Zhang 2006).
    eps = jnp.finfo(g.dtype).eps
    lost = jnp.minimum(state.look.round_off / scale, eps ** (2 / 3))
    search: Any = optax.scale_by_zoom_linesearch(
        trials, curv_rtol=solver._curvature, approx_dec_rtol=lost, initial_guess_strategy="one"
    )
    params = {"us": state.us, "shift": none}
    updates, found = search.update(
        {"us": first * d, "shift": none}, search.init(params), params,
        value=state.cost, grad={"us": jnp.where(d == 0, 0.0, g), "shift": g}, value_fn=value,
    )  # fmt: skip
    us = _project(state.us + updates["us"], bounds)
    length = first * found.learning_rate
    ok = (length > 0) & (found.value <= state.cost + lost * scale) & jnp.isfinite(found.value)
    ok &= jnp.isfinite(found.grad["shift"]).all() & (us != state.us).any()
    old = (state.us, state.cost, g, 0.0, state.predicted)
    new = (us, found.value, found.grad["shift"], length, length * jnp.sum(g * d))
    taken = jax.tree.map(lambda new, old: jnp.where(ok, new, old), new, old)
    us, cost, steepness, length, predicted = taken
    count = found.info.num_linesearch_steps
    return Step(us, cost, steepness, length, predicted, count, memory)


def as_before(state: DescentState, slope: Array, otherwise: Array) -> Array:
    """Return the length that predicts as much as the last step did, or `otherwise` at the start.

    Arguments: the slope of the cost along the new direction, and the other length, each ().
    """
    known = (state.predicted < 0) & (slope < 0)
    return jnp.where(known, state.predicted / jnp.where(known, slope, 1.0), otherwise)


def _longest(scale: Array, slope: Array) -> Array:
    """Return the step that would be the best if the cost were a parabola that touches zero there.

    No longer one is tried first: far from the optimum it may leap into another region, out of
    which nothing leads (Nocedal & Wright 2006, eq. 3.60, with zero for what is to be reached).
    """
    return jnp.where(slope < 0, -2 * scale / jnp.where(slope < 0, slope, -1.0), 1.0)


def _measure(problem: Problem, x0: Array, us: Array) -> Measured:
    """Roll out, expand and sweep."""
    bounds = problem.bounds
    xs = problem.rollout(x0, us)
    cost = problem.total_cost(xs, us)
    model = expand(problem, xs, us)
    sweep, side = lqr(model), jnp.zeros_like(us)
    if bounds is not None:
        sweep, side = box_lqr(model, bounds[0] - us, bounds[1] - us)
    start = start_status(problem, xs, us, Status.of(Reason.RUNNING))
    return Measured(cost, sweep, side, rounding(model, xs, cost), start)


def _measure_if(wanted: Array, problem: Problem, x0: Array, us: Array, last: Measured) -> Measured:
    """Sweep where it is wanted: a loop of one round, as under vmap `cond` would always sweep."""
    return jax.lax.while_loop(
        lambda carry: carry[0],
        lambda carry: (jnp.array(False), _measure(problem, x0, us)),
        (wanted, last),
    )[1]


def step(problem: Problem, state: DescentState, solver: "AbstractDescent") -> DescentState:
    """Search along the next direction, and sweep where that may have converged.

    The first step only measures the start. After a search in vain the memory is emptied; after
    one along the steepest descent it ends.
    """
    bounds = problem.bounds

    def stay():
        zero = jnp.zeros((), state.cost.dtype)
        return Step(state.us, state.cost, state.steepness, zero, zero, jnp.array(0), state.memory)

    new = jax.lax.cond(state.measured, lambda: _search(problem, state, solver), stay)
    scale = cost_scale(new.cost, state.start_cost)
    curvature = state.look.sweep.curvature
    gradient = projected_gradient(new.us, new.steepness, curvature, scale, bounds)
    vain = state.measured & (new.length == 0)
    stuck = vain & state.fresh
    wanted = state.status.is_(Reason.RUNNING)
    wanted &= ~state.measured | (gradient <= state.level) | vain
    look = _measure_if(wanted, problem, state.x0, new.us, state.look)
    cost = jnp.where(state.measured, new.cost, look.cost)
    start_cost = jnp.where(state.measured, state.start_cost, look.cost)
    scale = cost_scale(cost, start_cost)
    sweep = look.sweep
    exact = projected_gradient(new.us, sweep.gradient, sweep.curvature, scale, bounds)
    gradient = jnp.where(wanted, exact, gradient)
    after = DescentState(
        x0=state.x0,
        us=new.us,
        cost=cost,
        steepness=jnp.where(wanted, sweep.gradient, new.steepness),
        start_cost=start_cost,
        memory=_select(vain, solver._begin(new.us), new.memory),
        fresh=vain | ~state.measured,
        look=look,
        gradient=gradient,
        level=jnp.where(wanted, _level(look, gradient, scale, solver.tolerances), state.level),
        length=new.length,
        predicted=new.predicted,
        trials=new.trials,
        measured=jnp.array(True),
        num_accepted=state.num_accepted + (new.length > 0),
        status=state.status,
    )
    status = _judge(state, after, stuck, wanted, solver.tolerances)
    return eqx.tree_at(lambda s: s.status, after, status)


def _select(condition, yes, no):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _level(look: Measured, gradient: Array, scale: Array, tolerances: Tolerances) -> Array:
    """Return the gradient at which the next sweep may find convergence.

    What a sweep expects of the cost falls as the gradient's square.
    """
    gradient_tol, cost_tol, _ = tolerances.resolve(gradient.dtype)
    relative = expected_reduction(look.sweep) / scale
    known = look.sweep.ok & look.sweep.settled & (relative > 0)
    fall = jnp.where(known, jnp.sqrt(cost_tol / jnp.where(known, relative, 1.0)), 0.5)
    return jnp.minimum(gradient_tol, jnp.clip(fall, 0.1, 0.8) * gradient)


def _judge(
    old: DescentState, new: DescentState, stuck: Array, swept: Array, tolerances: Tolerances
) -> Status:
    """Say why to stop, or RUNNING."""
    sweep, round_off = new.look.sweep, new.look.round_off
    running = Status.of(Reason.RUNNING)
    status = _status.where(stuck, Status.of(Reason.LINE_SEARCH_FAILED), running)
    lost = stuck & sweep.ok & sweep.settled & (expected_reduction(sweep) <= round_off)
    status = _status.where(lost, Status.of(Reason.STALLED), status)
    found = converged(
        status, sweep, new.us, new.cost, cost_scale(new.cost, new.start_cost), new.gradient,
        round_off, sure=jnp.array(True), first=new.num_accepted == 0, tolerances=tolerances,
    )  # fmt: skip
    status = _status.where(swept, found, status)
    bad = ~old.measured & ~new.look.start.is_(Reason.RUNNING)
    status = _status.where(bad, new.look.start, status)
    return _status.where(old.status.is_(Reason.RUNNING), status, old.status)


class AbstractDescent(AbstractMinimiser):
    """A solver of this kind: it says which direction to search, and how exactly."""

    stochastic: ClassVar[bool] = False
    _curvature: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def _begin(self, us: Float[Array, "T nu"]) -> Any:
        """Return the empty memory for controls like us (T, nu)."""

    @abc.abstractmethod
    def _direction(
        self, point: Point, state: DescentState
    ) -> tuple[Float[Array, "T nu"], Float[Array, ""], Any]:
        """Return a direction of descent (T, nu), the first step to try along it, and the memory.

        With an empty memory, `state.fresh`, the direction is along -g/metric.
        """

    def init(self, problem, x0, us):
        """Return the state before anything was computed, from us (T, nu) and x0 (nx,)."""
        if not reversible(lambda us: problem.total_cost(problem.rollout(x0, us), us), us):
            raise ValueError(f"{type(self).__name__}: {NO_REVERSE}; ILQR and DDP do without")
        us = clip(us, problem.bounds)
        none = jnp.zeros_like(us)
        number, unknown = jnp.zeros((), us.dtype), jnp.full((), jnp.nan, us.dtype)
        running = Status.of(Reason.RUNNING)
        return DescentState(
            x0=x0,
            us=us,
            cost=unknown,
            steepness=jnp.zeros_like(us),
            start_cost=number,
            memory=self._begin(us),
            fresh=jnp.array(True),
            look=Measured(unknown, no_sweep(us, x0.size), none, number, running),
            gradient=unknown,
            level=number,
            length=number,
            predicted=number,
            trials=jnp.array(0),
            measured=jnp.array(False),
            num_accepted=jnp.array(0),
            status=input_status(problem, x0, us),
        )

    def step(self, problem, state, last=False):
        """Search along a direction and judge where it led; arrays keep their shapes."""
        return step(problem, state, self)

    def record(self, state):
        """Return cost, projected gradient, length of the step and 0, each of shape ()."""
        return Record(state.cost, state.gradient, state.length, jnp.zeros_like(state.cost))

    def final(self, state):
        """Return True, shape (): gains are made at the end."""
        return jnp.array(True)

    def found(self, problem, state):
        """Return the last trajectory, xs (T+1, nx) and us (T, nu), and the gains around it.

        Without noise the policy reproduces that trajectory: the step that the sweep would take
        next is not part of it.
        """
        xs = problem.rollout(state.x0, state.us)
        side = _measure(problem, state.x0, state.us).side
        K = self.gains(problem, xs, state.us, side)
        return Found(xs, state.us, K, side, state.gradient)

    def gains(self, problem, xs, us, side):
        """Return the gains (T, nu, nx) of a Riccati sweep around xs (T+1, nx), us (T, nu)."""
        return factorise(expand(problem, xs, us), side == 0).K
