"""The one loop that drives every iterative solver, and where its adjoint is attached."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from . import _status
from ._adjoint import attach, attach_gains, known_sides
from ._adjoint_expected import Expected, attach_expected, outcome
from ._checks import (
    check_again,
    check_instance,
    check_integer,
    converted,
    is_checked,
    is_concrete,
    mark_checked,
)
from ._controller import AffinePolicy
from ._delay import delayed
from ._estimator import OutputFeedback
from ._function import closed
from ._jit import jit
from ._lifted import lifted
from ._prediction import Prediction
from ._problem import Problem, check_us, check_x0
from ._simulate import simulate
from ._solution import Solution, SolveError, last_finite
from ._solve_checks import check_finite, check_functions
from ._solver import AbstractDirectSolver, AbstractSolver, Found, Record
from ._status import Reason, Status
from ._terms import check, parts
from ._types import promote
from ._unseen import warn_unseen

POLICIES = AffinePolicy | OutputFeedback
LARGEST_HISTORY = 1.0
"""What the record of all iterations may take [GB]."""


def solve(
    problem: Problem,
    solver: AbstractSolver | AbstractDirectSolver,
    x0: ArrayLike,
    us: ArrayLike | AffinePolicy | OutputFeedback | None = None,
    *,
    max_steps: int = 500,
    throw: bool = False,
) -> Solution:
    """Minimise a problem's cost over the controls, from the state x0.

    Works eagerly and, but for `BoundaryValue`, under jit, vmap and grad. Gradients of `cost`, `xs`
    and `us` with respect to x0 and every number in the problem follow from the implicit function
    theorem, exact to second order (see `docs/design.md`); they are NaN where the solve did not
    converge. So do those of the policy, gains included, and of what is simulated with it.

    Arguments:
        problem: what to solve. All its arrays, x0 and us are promoted to one floating dtype, the
            widest among them.
        solver: how, such as `jc.ILQR()`.
        x0: starting state, shape (nx,).
        us: starting controls, shape (T, nu); the plant's nominal control by default. Or a policy,
            such as `solution.policy.shifted(1)` of the plan before: its controls in closed loop
            from x0. Where these are not finite the status says so.
        max_steps: limit of the iterations; static. `BoundaryValue` has limits of its own.
        throw: raise `SolveError` when the solve does not converge, instead of a status.

    Returns: `Solution`; look at `solution.status.ok` before using it.

    Raises: ValueError or TypeError, naming the argument, for shapes that do not fit and for
    values that are not finite where they can be known; `SolveError` with `throw=True`
    (inside a `jit` of your own Equinox's runtime error, which cannot say why).
    """
    check_instance("problem", problem, Problem, "a jc.Problem is wanted")
    check_instance(
        "solver", solver, AbstractSolver | AbstractDirectSolver, "a solver is wanted, jc.ILQR()"
    )
    max_steps = check_max_steps(max_steps)
    fresh = not is_checked(problem)
    if fresh:
        problem = converted(problem)
        problem.check_single()
        check_again(problem)
    start = check_x0(problem, x0)
    controls = roll(problem, us, start) if isinstance(us, POLICIES) else check_us(problem, us)
    given = problem
    problem, start, controls = promote((closed(problem), start, controls))
    if fresh:
        check_finite(problem)
        check(problem.cost, problem.plant)
        mark_checked(given)
    for part in parts(problem.cost):
        if (check_start := getattr(part, "check_start", None)) is not None:
            check_start(problem.plant, start)
    _warn(problem, solver, start.dtype)
    if fresh and problem.sensor is not None and getattr(solver, "stochastic", False):
        warn_unseen(problem, start)
    solution = run(problem, solver, start, controls, max_steps)
    return _throw(solution) if throw else solution


def roll(problem: Problem, policy: AffinePolicy | OutputFeedback, x0: Array) -> Array:
    """Return a policy's controls (T, nu) in closed loop from x0 (nx,), as constants."""
    leaves, rest = eqx.partition((problem, policy, x0), eqx.is_array)
    return simulate(*eqx.combine(jax.lax.stop_gradient(leaves), rest)).us


def check_max_steps(max_steps: int) -> int:
    """Return it as an int; raises TypeError or ValueError when it is none, or far too large."""
    max_steps = check_integer("max_steps", max_steps, 0)
    size = 8e-9 * len(Record._fields) * max_steps
    if size > LARGEST_HISTORY:
        raise ValueError(
            f"max_steps: the history of {max_steps} iterations would take {size:.3g} GB of memory; "
            f"at most {LARGEST_HISTORY:g} GB are allowed"
        )
    return max_steps


def _warn(problem: Problem, solver: AbstractSolver | AbstractDirectSolver, dtype) -> None:
    ignored = [name for name in ("noise", "sensor") if getattr(problem, name) is not None]
    if ignored and not getattr(solver, "stochastic", False):
        warnings.warn(
            f"{type(solver).__name__} minimises the nominal cost: it ignores the problem's "
            f"{' and '.join(ignored)}, which acts in `simulate` alone; jc.ILQG() plans with it",
            stacklevel=3,
        )
    eps = float(jnp.finfo(dtype).eps)
    for name in ("gradient_tolerance", "cost_tolerance", "step_tolerance"):
        value = getattr(solver, name, None)
        if value is not None and not value >= 0:
            raise ValueError(f"{name}: a number >= 0 is wanted, got {value!r}")
        if value is not None and value < 10 * eps:
            warnings.warn(
                f"{name} = {value:g} is below 10 eps of {dtype}, {10 * eps:.1g}: it may never be "
                "reached",
                stacklevel=3,
            )


def run(
    problem: Problem, solver: AbstractSolver | AbstractDirectSolver, x0, us, max_steps: int
) -> Solution:
    """Solve a problem whose arguments have been checked."""
    if isinstance(solver, AbstractDirectSolver):
        check_functions(problem, x0, us)
        return solver.run(problem, x0, us)
    return run_iteration(problem, solver, x0, us, max_steps)


@jit
def run_iteration(problem: Problem, solver: AbstractSolver, x0, us, max_steps: int) -> Solution:
    check_functions(problem, x0, us)
    if solver.stochastic and delayed(problem.sensor):
        whole = run_iteration(lifted(problem, x0), solver, problem.lift(x0), us, max_steps)
        return _projected(whole, problem)
    frozen, x0_frozen, us = jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf,
        (problem, x0, us),
    )
    state, history, count = _iterate(frozen, solver, x0_frozen, us, max_steps)
    found = solver.found(frozen, state)
    status = _final_status(solver, state, found)
    failed = status.code >= int(Reason.NONFINITE_INPUT)
    found = found._replace(xs=jnp.where(failed, last_finite(found.xs), found.xs))
    cost = solver.record(state).cost
    side = known_sides(frozen, found.us, found.side)
    if solver.stochastic and problem.uncertain:
        promised = outcome(frozen, found.xs, found.us, found.K)
        promised = attach_expected(promised, problem, x0, side, status.ok, solver)
        cost = promised.nominal_cost
    else:
        promised = _certain(found, cost, problem, x0, side, status.ok, solver)
    feedback = status.ok & _feedback_needed(frozen, found, cost)
    status = Status(status.code, status.index, feedback)
    xs, us, K = promised.xs, promised.us, promised.K
    policy = AffinePolicy(xs, us, jnp.zeros_like(us), K, problem.bounds, problem.dt)
    if promised.estimator is not None:
        policy = OutputFeedback(policy, promised.estimator)
    return Solution(
        xs=xs,
        us=us,
        nominal_cost=promised.nominal_cost,
        expected_cost=promised.expected_cost,
        policy=policy,
        status=status,
        gradient=found.gradient,
        history=history,
        num_steps=count,
        prediction=promised.prediction,
    )


def _projected(whole: Solution, problem: Problem) -> Solution:
    """Return a solution in the plant's own states; its policy remembers what has been sensed."""
    nx, seen = problem.plant.nx, whole.prediction
    assert seen is not None and seen.error_cov is not None
    prediction = Prediction(
        problem.project(seen.xs),
        seen.us,
        seen.x_cov[:, :nx, :nx],
        seen.u_cov,
        seen.error_cov[:, :nx, :nx],
    )
    return eqx.tree_at(
        lambda s: (s.xs, s.prediction), whole, (problem.project(whole.xs), prediction)
    )


def _certain(found: Found, cost, problem: Problem, x0, side, ok, solver) -> Expected:
    """Return what was found without noise, with its derivatives."""
    xs, us, cost = attach((found.xs, found.us, cost), problem, x0, side, ok)
    K = attach_gains(found.K, problem, xs, us, side, ok, solver)
    return Expected(xs, us, K, cost, cost, None)


def _iterate(problem, solver, x0, us, max_steps):
    """Run the solver until it stops; return its state, the padded history and the count."""
    state = solver.init(problem, x0, us)
    padded = jax.tree.map(
        lambda leaf: jnp.full(max_steps + 1, jnp.nan, leaf.dtype), solver.record(state)
    )

    def going(state, count):
        return solver.status(state).is_(Reason.RUNNING) & (count <= max_steps)

    def unfinished(carry):
        state, _, count = carry
        failed = solver.status(state).code >= int(Reason.NONFINITE_INPUT)
        return going(state, count) | (~solver.final(state) & ~failed)

    def body(carry):
        state, history, count = carry
        # Where it has ended, once more for the gains.
        more = going(state, count)
        state = solver.step(problem, state, ~more)
        history = jax.tree.map(
            lambda h, r: h.at[count].set(jnp.where(more, r, h[count])),
            history,
            solver.record(state),
        )
        return state, history, count + more

    state, history, count = jax.lax.while_loop(unfinished, body, (state, padded, jnp.array(0)))
    # The first pass only measures the start.
    return state, history, jnp.maximum(count - 1, 0)


def _feedback_needed(problem: Problem, found: Found, cost: Array) -> Array:
    """Tell whether controls, their last digits changed, lead to other states and costs; shape ().

    To first order the cost of an optimum does not change at all; to be sure, states and costs both
    differ by more than sqrt(eps).
    """
    eps = float(jnp.finfo(cost.dtype).eps)
    us = found.us * (1 + eps)
    xs = problem.rollout(found.xs[0], us)
    again = problem.total_cost(xs, us)
    moved = jnp.abs(xs - found.xs).max(0) > eps**0.5 * jnp.abs(found.xs).max(0)
    dearer = ~(jnp.abs(again - cost) <= eps**0.5 * jnp.maximum(jnp.abs(cost), jnp.abs(again)))
    return (moved.any() | ~jnp.isfinite(xs).all()) & dearer


def _final_status(solver, state, found: Found) -> Status:
    status = solver.status(state)
    # What is returned may be an earlier iterate.
    near = solver.near(state) & ~(found.gradient > solver.record(state).gradient)
    limit = _status.where(near, Status.of(Reason.NEARLY_CONVERGED), Status.of(Reason.MAX_STEPS))
    return _status.where(status.is_(Reason.RUNNING), limit, status)


def _throw(solution: Solution) -> Solution:
    if is_concrete(solution.status.code):
        if not np.asarray(solution.status.ok).all():
            raise SolveError(solution.status.message)
        return solution
    return eqx.error_if(
        solution, ~solution.status.ok, "solve(..., throw=True): a solve did not converge"
    )
