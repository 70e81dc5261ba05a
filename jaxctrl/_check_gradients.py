"""Compare the derivatives of a solve with differences of solves."""

import dataclasses
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ._jit import jit
from ._problem import Problem, check_us, check_x0
from ._simulate import simulate
from ._solution import SolveError
from ._solve import run, solve
from ._solve_checks import parts_name
from ._solver import AbstractSolver
from ._types import promote
from .solvers.ddp import DDP

STEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
"""Relative steps that are tried."""
SIZE_OF_ZERO = 1e-3
"""The size that an input counts as having that is zero: absent weights, a target at the origin."""
TIGHT = 1e-7
"""The relative projected gradient below which a solve beside the optimum counts."""
KINK = 30.0
"""How many uncertainties apart the quotients of two sides are at a kink, not only noisy."""
NOTHING = 1e-7
"""A change relative to the output itself, for a whole change of the input, that counts as none."""
ASIDE = 1e-2
"""By how much the disturbed run starts aside, relative to one more than each state's range."""
TRIFLE = 1e-6
"""The relative error below which no kink is looked for."""
OUTPUTS = ("cost", "xs[-1]", "us", "gains", "closed loop", "covariance")
"""Of a solver without a prediction, the first five."""
STOCHASTIC = {"gradient_tolerance": 1e-11, "cost_tolerance": 1e-14, "step_tolerance": 1e-10}
"""Tolerances of a stochastic solver's tight solves, which end at its own point of rest."""


class GradientRow(NamedTuple):
    """One line of a report: a derivative of one output along one direction of one input.

    Attributes:
        name: of the input, such as `plant.skeleton.m2`. output: "cost", "xs[-1]", "us", "gains",
            "closed loop", the states of the policy's run from a start that is pushed aside, or
            "covariance", that predicted of the last state.
        derivative, difference: norms of the derivative along the input's direction, and of the
            difference quotient. The direction is random, with entries of 0.5 to 1 times the
            input's largest one (0.001 where all are zero), and the same in every report.
        error: the norm of what they differ by, relative to the larger of the two, or to 1e-7 of the
            output where both are smaller. The derivative
            is as good as the solve: with a gradient tolerance g expect up to a few g.
        uncertainty: by how much difference quotients of two steps differ, in the same measure; an
            error that is not above it says nothing.
        step: the step of the difference, relative to the size of the input.
        side: "+-" for a central difference; "+" or "-" for a one-sided one, taken where there is
            no optimum on the other side, or a kink between them: a control that just meets its
            bound follows it one way only.
        transposed: by how much reverse mode differs from forward mode, relative.

    The last five are the columns `error`, `uncertain`, `step`, `side` and `transp.` of the table.
    """

    name: str
    output: str
    derivative: float
    difference: float
    error: float
    uncertainty: float
    step: float
    side: str
    transposed: float


class GradientReport:
    """What `check_gradients` found; printed, it is a table.

    Attributes:
        rows: a `GradientRow` for each input and output. worst: the largest error among them.
    """

    def __init__(self, rows: tuple[GradientRow, ...]):
        self.rows = rows

    @property
    def worst(self) -> float:
        """The largest relative error; NaN if one is."""
        return float(np.max([row.error for row in self.rows]))

    def __str__(self) -> str:
        width = max(len(row.name) for row in self.rows)
        head = f"{'input':<{width}}  output     {'derivative':>12}{'difference':>12}{'error':>9}"
        lines = [head + f"{'uncertain':>10}{'step':>9}{'side':>5}{'transp.':>9}"]
        for row in self.rows:
            lines.append(
                f"{row.name:<{width}}  {row.output:<11}"
                f"{row.derivative:>12.4e}{row.difference:>12.4e}"
                f"{row.error:>9.1e}{row.uncertainty:>10.1e}{row.step:>9.1e}{row.side:>5}"
                f"{row.transposed:>9.1e}"
            )
        return "\n".join([*lines, f"worst error {self.worst:.1e}"])

    __repr__ = __str__


def check_gradients(
    problem: Problem,
    solver: AbstractSolver,
    x0: ArrayLike,
    us: ArrayLike | None = None,
    *,
    where: Callable[[str], bool] | None = None,
    seed: int = 0,
) -> GradientReport:
    """Compare the derivatives of a solve, for every input, with differences of tight solves.

    For x0 and every array of the problem, one random direction v is drawn, of the input's own
    size and the same in every call. The derivatives along v of cost, last state, controls, gains
    and of a disturbed run under the policy are compared with central differences, extrapolated
    (Richardson) from two steps, of solves by `DDP` to round-off, each started at the optimum
    itself; gains are the solver's own there. Of a solver that plans with noise the solves are its
    own, and the predicted covariance of the last state is compared, too. Of several steps the one
    is taken whose quotients agree best: long ones change which bounds hold. Where a control just
    meets its bound, with a gradient of zero, the optimum has two one-sided derivatives: when the
    difference quotients of the two sides tell them apart, the nearer one is compared. (A muscle at
    rest at the end of a movement, where its excitation no longer changes the cost, is such a
    control.)

    Meant for a look at a new problem, in float64: it solves some twenty times per input.

    Arguments:
        problem, solver, x0, us: as in `solve`; the solve must converge.
        where: takes the name of an input, such as `plant.skeleton.m2`, and tells whether to check
            it; all by default. Arrays that are not finite, such as absent bounds, are left out.
        seed: of the directions.

    Returns: `GradientReport`: print it (`help(jc.GradientRow)` explains the columns), or look at
    `worst`. Wrong derivatives are off by 1e-2 and more; errors of 1e-4 and less tell of a loose
    solve, and fall with `DDP(gradient_tolerance=1e-9)`.

    Raises: as `solve` does; `SolveError` when it does not converge; ValueError in float32, where
    differences say nothing.
    """
    start, controls = check_x0(problem, x0), check_us(problem, us)
    problem, start, controls = promote((problem, start, controls))
    if start.dtype != jnp.float64:
        raise ValueError(
            f"x0, problem: got {start.dtype}, wanted float64, without which differences say "
            "nothing: jax.config.update('jax_enable_x64', True)"
        )
    solution = solve(problem, solver, start, controls, throw=True)
    inputs, static = eqx.partition({"x0": start, "problem": problem}, eqx.is_inexact_array)
    aside = ASIDE * (1 + jnp.max(jnp.abs(solution.xs), axis=0))
    found = _Solves(static, solver, controls, solution.us, aside)
    paths, tree = jax.tree_util.tree_flatten_with_path(inputs)
    rows: list[GradientRow] = []
    for i, (path, leaf) in enumerate(paths):
        name = parts_name(path).removeprefix("problem.")
        finite = bool(np.isfinite(np.asarray(leaf)).all())
        if not finite or leaf.size == 0 or (where is not None and not where(name)):
            continue
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        size = float(jnp.max(jnp.abs(leaf))) or SIZE_OF_ZERO
        direction = jnp.asarray(size * rng.uniform(0.5, 1.0, leaf.shape), leaf.dtype)
        if name == "x0_cov":  # which stays one
            direction = 0.5 * (leaf * direction[0] + (leaf * direction[0]).T) / size
        leaves = [jnp.zeros_like(other) for _, other in paths]
        leaves[i] = direction
        rows += _compare(name, found, inputs, jax.tree.unflatten(tree, leaves), rng)
    if not rows:
        raise ValueError("where: selects no input")
    return GradientReport(tuple(rows))


class _Solves(eqx.Module):
    """The solve as a function of its differentiable inputs, and its tight counterpart.

    `aside`, how far the disturbed run starts aside, is one number for each state: were it to follow
    the range of the states, it would have a kink where two of them are the largest.
    """

    static: Any
    solver: AbstractSolver
    start: Array
    optimum: Array
    aside: Array

    def _outputs(self, inputs, solver, us) -> tuple[tuple[Array, ...], Any]:
        whole = eqx.combine(inputs, self.static)
        solution = run(whole["problem"], solver, whole["x0"], us, 500)
        return (
            solution.cost,
            solution.xs[-1],
            solution.us,
            *self._policy(whole, solution),
            *([] if solution.prediction is None else [solution.prediction.x_cov[-1]]),
        ), solution

    def _policy(self, whole, solution) -> tuple[Array, Array]:
        """Return the gains, and the states of a run that starts aside."""
        start = whole["x0"] + self.aside
        return solution.policy.K, simulate(whole["problem"], solution.policy, start).xs

    @jit
    def forward(self, inputs, tangents):
        """Return the directional derivatives of the outputs."""
        solve = lambda inputs: self._outputs(inputs, self.solver, self.start)[0]  # noqa: E731
        return jax.jvp(solve, (inputs,), (tangents,))[1]

    @jit
    def backward(self, inputs, cotangents):
        """Return the inputs' cotangents."""
        solve = lambda inputs: self._outputs(inputs, self.solver, self.start)[0]  # noqa: E731
        return jax.vjp(solve, inputs)[1](cotangents)[0]

    @jit
    def moved(self, inputs, tangents, h):
        """Return the outputs after a step h along the tangents, and how well they were found."""
        there = jax.tree.map(lambda leaf, tangent: leaf + h * tangent, inputs, tangents)
        if self.solver.stochastic:
            tight = dataclasses.replace(self.solver, **STOCHASTIC)
            return self._outputs(there, tight, self.optimum)
        # Tolerances that are never met: it goes on until the gradient falls no more.
        tight = DDP(gradient_tolerance=0.0)
        values, solution = self._outputs(there, tight, self.optimum)
        if isinstance(self.solver, DDP):
            return values, solution
        # From that optimum the solver takes no step: its gains there.
        own = self._outputs(there, self.solver, solution.us)[0]
        return (*values[:3], *own[3:]), solution


def _compare(name: str, found: _Solves, inputs, tangents, rng) -> list[GradientRow]:
    """Return a row for each output."""
    derivatives = [np.asarray(derivative) for derivative in found.forward(inputs, tangents)]
    differences = _Differences(found, inputs, tangents)
    rows = []
    for j, (output, derivative) in enumerate(zip(OUTPUTS, derivatives, strict=False)):
        side, difference, uncertainty, step = differences.nearest(derivative, j)
        size = max(np.linalg.norm(derivative), np.linalg.norm(difference), differences.trifle(j))
        size = size if size > 0 else 1.0
        cotangents = [np.zeros(np.shape(d)) for d in derivatives]
        cotangents[j] = rng.normal(size=derivative.shape)
        pulled = found.backward(inputs, tuple(jnp.asarray(c, derivative.dtype) for c in cotangents))
        both = zip(jax.tree.leaves(pulled), jax.tree.leaves(tangents), strict=True)
        reverse = sum(float(jnp.sum(a * b)) for a, b in both if bool(jnp.any(b != 0)))
        forward = float(np.sum(cotangents[j] * derivative))
        rows.append(
            GradientRow(
                name,
                output,
                derivative=float(np.linalg.norm(derivative)),
                difference=float(np.linalg.norm(difference)),
                error=float(np.linalg.norm(derivative - difference) / size),
                uncertainty=float(uncertainty / size),
                step=step,
                side=side,
                transposed=float(abs(reverse - forward) / (np.linalg.norm(cotangents[j]) * size)),
            )
        )
    return rows


class _Differences:
    """Difference quotients of the outputs along one direction, of second order."""

    def __init__(self, found: _Solves, inputs, tangents):
        self._given = (found, inputs, tangents)
        self._outputs: dict[float, Any] = {}
        self._quotients: dict[str, list] = {}

    def nearest(self, derivative: np.ndarray, j: int) -> tuple[str, np.ndarray, float, float]:
        """Return the side, value, uncertainty and step of the quotient of output j to compare.

        Central where both sides have an optimum and agree.
        """
        central = self._extrapolated("+-", j)
        if central is not None:
            _, value, uncertainty, _ = central
            off = np.linalg.norm(value - derivative)
            if off <= max(KINK * uncertainty, TRIFLE * np.linalg.norm(derivative)):
                return central
        sides = [self._extrapolated(side, j) for side in ("+", "-")]
        known = [side for side in sides if side is not None]
        if not known and central is None:
            raise SolveError("check_gradients: no solve beside the optimum could be made tight")
        if central is not None and not _differ(known):
            return central
        return min(known, key=lambda side: np.linalg.norm(side[1] - derivative))

    def trifle(self, j: int) -> float:
        """Return the change of output j that is as good as none: rounding makes up as much."""
        values = self._at(0.0)
        return 0.0 if values is None else NOTHING * float(np.linalg.norm(values[j]))

    def _at(self, h: float):
        """Return the outputs after a step h, or None where no tight solve was to be had."""
        if h not in self._outputs:
            found, inputs, tangents = self._given
            values, solution = found.moved(inputs, tangents, jnp.asarray(h))  # static, a float
            tight = float(solution.gradient) < TIGHT
            self._outputs[h] = [np.asarray(v) for v in values] if tight else None
        return self._outputs[h]

    def _quotient(self, side: str, h: float):
        if side == "+-":
            points, weights = (h, -h), (0.5, -0.5)
        else:
            h = h if side == "+" else -h
            points, weights = (0.0, h, 2 * h), (-1.5, 2.0, -0.5)
        values = [self._at(point) for point in points]
        if any(value is None for value in values):
            return None
        parts = zip(*values, strict=True)
        return [sum(w * v for w, v in zip(weights, part, strict=True)) / h for part in parts]

    def _extrapolated(self, side: str, j: int) -> tuple[str, np.ndarray, float, float] | None:
        """Return Richardson's extrapolation where it changes least, that change, and the step."""
        if side not in self._quotients:
            pairs = [(h, self._quotient(side, h), self._quotient(side, h / 2)) for h in STEPS]
            self._quotients[side] = [(h, a, b) for h, a, b in pairs if None not in (a, b)]
        best, last = None, None
        for h, a, b in self._quotients[side]:
            value, change = b[j] + (b[j] - a[j]) / 3, np.linalg.norm(b[j] - a[j]) / 3
            if last is not None:  # those of neighbouring steps should agree better
                change = min(change, np.linalg.norm(value - last))
            if best is None or change < best[2]:
                best = (side, value, float(change), h)
            last = value
        return best


def _differ(sides) -> bool:
    """Tell whether the quotients of two sides differ by more than they are uncertain."""
    if len(sides) < 2:
        return False
    (_, a, da, _), (_, b, db, _) = sides
    return bool(np.linalg.norm(a - b) > KINK * (da + db))
