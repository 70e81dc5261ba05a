"""Compare the derivatives of a solve with differences of solves."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._problem import Problem, check_us, check_x0
from .._types import promote
from ._abstract import AbstractSolver
from ._solution import SolveError
from ._solve import parts_name, run, solve
from .ddp import DDP

STEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
"""Relative steps that are tried."""
SIZE_OF_ZERO = 1e-3
"""The size that an input counts as having that is zero: absent weights, a target at the origin."""
TIGHT = 1e-7
"""The relative projected gradient below which a solve beside the optimum counts."""
OUTPUTS = ("cost", "xs[-1]", "us")


class GradientRow(NamedTuple):
    """One line of a report: a derivative of one output along one direction of one input.

    Attributes:
        name: of the input, such as `plant.skeleton.m2`. output: "cost", "xs[-1]" or "us".
        derivative, difference: norms of the directional derivative and of the difference quotient.
        error: the norm of what they differ by, relative to the larger of the two.
        uncertainty: by how much difference quotients of two steps differ, in the same measure; an
            error that is not above it means nothing.
        step: the step of the difference, relative to the size of the input.
        transposed: by how much reverse mode differs from forward mode, relative.
    """

    name: str
    output: str
    derivative: float
    difference: float
    error: float
    uncertainty: float
    step: float
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
        head = f"{'input':<{width}}  output  {'derivative':>12}{'difference':>12}{'error':>9}"
        lines = [head + f"{'+-':>9}{'step':>9}{'vjp-jvp':>9}"]
        for row in self.rows:
            lines.append(
                f"{row.name:<{width}}  {row.output:<6}"
                f"{row.derivative:>13.4e}{row.difference:>12.4e}"
                f"{row.error:>9.1e}{row.uncertainty:>9.1e}{row.step:>9.1e}{row.transposed:>9.1e}"
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
    size. The derivatives of cost, last state and controls along v are compared with central
    differences, extrapolated (Richardson) from two steps, of solves by `DDP` to round-off, each
    started at the optimum itself. Of several steps the one is taken whose quotients agree best:
    long ones change which bounds hold. At a point where a control is just about to meet its bound,
    the optimum has two one-sided derivatives, and no step agrees.

    Meant for a look at a new problem, in float64: it solves some twenty times per input.

    Arguments:
        problem, solver, x0, us: as in `solve`; the solve must converge.
        where: takes the name of an input, such as `plant.skeleton.m2`, and tells whether to check
            it; all by default. Arrays that are not finite, such as absent bounds, are left out.
        seed: of the directions.

    Returns: `GradientReport`: print it, or look at `worst`.

    Raises: as `solve` does; `SolveError` when it does not converge.
    """
    start, controls = check_x0(problem, x0), check_us(problem, us)
    problem, start, controls = promote((problem, start, controls))
    solution = solve(problem, solver, start, controls, throw=True)
    inputs, static = eqx.partition({"x0": start, "problem": problem}, eqx.is_inexact_array)
    found = _Solves(static, solver, controls, solution.us)
    paths, tree = jax.tree_util.tree_flatten_with_path(inputs)
    rng = np.random.default_rng(seed)
    rows: list[GradientRow] = []
    for i, (path, leaf) in enumerate(paths):
        name = parts_name(path).removeprefix("problem.")
        finite = bool(np.isfinite(np.asarray(leaf)).all())
        if not finite or leaf.size == 0 or (where is not None and not where(name)):
            continue
        size = float(jnp.max(jnp.abs(leaf))) or SIZE_OF_ZERO
        direction = jnp.asarray(size * rng.uniform(0.5, 1.0, leaf.shape), leaf.dtype)
        leaves = [jnp.zeros_like(other) for _, other in paths]
        leaves[i] = direction
        rows += _compare(name, found, inputs, jax.tree.unflatten(tree, leaves), rng)
    if not rows:
        raise ValueError("where: selects no input")
    return GradientReport(tuple(rows))


class _Solves(eqx.Module):
    """The solve as a function of its differentiable inputs, and its tight counterpart."""

    static: Any
    solver: AbstractSolver
    start: Array
    optimum: Array

    def _outputs(self, inputs, solver, us) -> tuple[tuple[Array, Array, Array], Any]:
        whole = eqx.combine(inputs, self.static)
        solution = run(whole["problem"], solver, whole["x0"], us, 500)
        return (solution.cost, solution.xs[-1], solution.us), solution

    @eqx.filter_jit
    def forward(self, inputs, tangents):
        """Return the directional derivatives of the outputs."""
        solve = lambda inputs: self._outputs(inputs, self.solver, self.start)[0]  # noqa: E731
        return jax.jvp(solve, (inputs,), (tangents,))[1]

    @eqx.filter_jit
    def backward(self, inputs, cotangents):
        """Return the inputs' cotangents."""
        solve = lambda inputs: self._outputs(inputs, self.solver, self.start)[0]  # noqa: E731
        return jax.vjp(solve, inputs)[1](cotangents)[0]

    @eqx.filter_jit
    def moved(self, inputs, tangents, h):
        """Return the outputs after a step h along the tangents, and how well they were found."""
        there = jax.tree.map(lambda leaf, tangent: leaf + h * tangent, inputs, tangents)
        # Tolerances that are never met: it goes on until the gradient falls no more.
        tight = DDP(gradient_tolerance=0.0)
        return self._outputs(there, tight, self.optimum)


def _compare(name: str, found: _Solves, inputs, tangents, rng) -> list[GradientRow]:
    """Return a row for each output."""
    derivatives = found.forward(inputs, tangents)
    differences = _differences(found, inputs, tangents)
    rows = []
    for j, output in enumerate(OUTPUTS):
        derivative = np.asarray(derivatives[j])
        by_step = [
            (h, np.asarray(values[j]), np.asarray(half[j])) for h, values, half in differences
        ]
        difference, uncertainty, step = _extrapolate(by_step)
        size = max(np.linalg.norm(derivative), np.linalg.norm(difference))
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
                float(np.linalg.norm(derivative)),
                float(np.linalg.norm(difference)),
                float(np.linalg.norm(derivative - difference) / size),
                float(uncertainty / size),
                step,
                float(abs(reverse - forward) / (np.linalg.norm(cotangents[j]) * size)),
            )
        )
    return rows


def _differences(found: _Solves, inputs, tangents) -> list[tuple[float, Any, Any]]:
    """Return difference quotients of the outputs with steps h and h/2, of second order both.

    Central ones; forward ones where the problem has no optimum on the other side, as with a
    weight that would be negative.
    """

    def outputs(h):
        values, solution = found.moved(inputs, tangents, jnp.asarray(h))  # a float would be static
        return values if float(solution.gradient) < TIGHT else None

    def quotient(h):
        ahead, behind = outputs(h), outputs(-h)
        if ahead is None:
            return None
        if behind is not None:
            return tuple((a - b) / (2 * h) for a, b in zip(ahead, behind, strict=True))
        here, further = outputs(0.0), outputs(2 * h)
        if here is None or further is None:
            return None
        three = zip(here, ahead, further, strict=True)
        return tuple((-3 * a + 4 * b - c) / (2 * h) for a, b, c in three)

    pairs = [(h, quotient(h), quotient(h / 2)) for h in STEPS]
    kept = [(h, a, b) for h, a, b in pairs if a is not None and b is not None]
    if not kept:
        raise SolveError("check_gradients: no solve beside the optimum could be made tight")
    return kept


def _extrapolate(quotients) -> tuple[np.ndarray, float, float]:
    """Return Richardson's extrapolation where it changes least, that change, and the step."""
    best = None
    values = [(h, b + (b - a) / 3, np.linalg.norm(b - a) / 3) for h, a, b in quotients]
    for i, (h, value, change) in enumerate(values):
        if i > 0:  # the extrapolations of neighbouring steps should agree better than the quotients
            change = min(change, np.linalg.norm(value - values[i - 1][1]))
        if best is None or change < best[1]:
            best = (value, float(change), h)
    assert best is not None
    return best
