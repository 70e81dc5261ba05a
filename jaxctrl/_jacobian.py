"""Jacobians and Hessians that use the structure of a function: which output depends on which input.

The step of a plant is mostly trivial: positions change by velocities, each muscle's activation by
its own control; only the accelerations depend on nearly everything. Rows that depend on much come
from reverse mode, one pass each; columns that then share no row are pushed forward together, many
in one pass (Curtis, Powell & Reid 1974; Coleman & Verma 1998). On the six-muscle arm this takes a
third of the time of forward mode alone.

Reverse mode does not go through a `lax.while_loop`, whose rounds are not known when it is traced;
forward mode does. Where there is one, all is done by forward mode.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.extend as jex
import jax.numpy as jnp
import numpy as np
from equinox.internal import nondifferentiable_backward

REVERSE = 2.0
"""What a reverse pass costs beside a forward one (measured)."""

_ELEMENTWISE = {
    "abs", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "cbrt", "ceil", "clamp",
    "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp", "exp2", "expm1",
    "floor", "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max",
    "min", "mul", "ne", "neg", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign",
    "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
_REDUCING = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or"}
_CONSTANT = {"iota", "stop_gradient"}
_KEEPING = {"convert_element_type", "copy"}
_FORWARD = {"while", "custom_linear_solve"}
"""What reverse mode may not go through."""
NO_REVERSE = (
    "reverse mode does not go through a lax.while_loop, nor a lax.fori_loop whose number of rounds "
    "is traced, and there is one in the plant or in the cost; write it with a fixed number of "
    "rounds, or give it a derivative of its own (jax.custom_jvp, jax.lax.custom_root)"
)


def jacobian(function: Callable, *, symmetric: bool = False) -> Callable:
    """Return the function whose value is the Jacobian (n, m) of a map from (m,) to (n,).

    Extra arguments pass through. With `symmetric` the Jacobian is known to be so, as a Hessian is:
    its dense rows are then read off its columns.
    """

    def evaluate(x, *args):
        closed, traced = _trace(function, x, *args)
        pattern = _pattern(closed, x.shape[0], len(args))
        rows, colour = _plan(pattern, symmetric)
        if not symmetric and len(rows) and not _reversible(closed, traced, x, *args):
            rows, colour = rows[:0], _colours(pattern)
        rest = np.delete(np.arange(len(pattern)), [] if symmetric else rows)

        def some(which):
            return lambda x: _take(traced(x, *args), which)

        # Each mode sees the function's own outputs alone, so that what they do not need is dropped.
        parts = []
        if len(rest):
            seeds = np.equal.outer(np.arange(colour.max(initial=0) + 1), colour)
            tangent = jax.vmap(lambda seed: jax.jvp(some(rest), (x,), (seed,))[1], out_axes=1)
            compressed = tangent(jnp.asarray(seeds, x.dtype))
            columns = [compressed[:, max(c, 0)] for c in colour]
            parts.append(jnp.where(jnp.asarray(pattern[rest]), jnp.stack(columns, axis=1), 0.0))
        if symmetric and len(rows):
            dense = np.isin(np.arange(len(pattern)), rows)
            return jnp.where(jnp.asarray(dense)[:, None], parts[0].T, parts[0])
        if len(rows):
            pull = jax.vjp(some(rows), x)[1]
            parts.append(jax.vmap(lambda seed: pull(seed)[0])(jnp.eye(len(rows), dtype=x.dtype)))
        return _take(jnp.concatenate(parts), np.argsort(np.concatenate([rest, rows])))

    return evaluate


def _take(a: jax.Array, which: np.ndarray) -> jax.Array:
    """Return some rows by slices of what is contiguous: unlike a gather, XLA sees through them."""
    breaks = np.flatnonzero(np.diff(which) != 1) + 1
    runs = [run for run in np.split(which, breaks) if len(run)]
    return jnp.concatenate([a[run[0] : run[-1] + 1] for run in runs])


def _plan(pattern: np.ndarray, symmetric: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows come from reverse mode and each column's colour, -1 where it needs none."""
    best = None
    filled = pattern.sum(axis=1)
    for limit in sorted({-1, *filled.tolist()}):
        rows = np.flatnonzero(filled > limit)
        if symmetric:  # these columns, each by itself, give these rows too
            colour = _colours(np.delete(pattern, rows, axis=0), alone=rows)
            cost = float(colour.max(initial=-1) + 1)
        else:
            colour = _colours(np.delete(pattern, rows, axis=0))
            cost = colour.max(initial=-1) + 1 + REVERSE * len(rows)
        if best is None or cost < best[0]:
            best = (cost, rows, colour)
    assert best is not None
    return best[1], best[2]


def _colours(pattern: np.ndarray, alone: Sequence[int] | np.ndarray = ()) -> np.ndarray:
    """Colour columns so that no two of one colour share a row; -1 for empty ones.

    Those in `alone` are given colours of their own.
    """
    m = pattern.shape[1]
    colour = np.full(m, -1)
    colour[list(alone)] = np.arange(len(alone))
    taken: list[np.ndarray] = []
    for j in np.argsort(-pattern.sum(axis=0), kind="stable"):
        if colour[j] >= 0 or not pattern[:, j].any():
            continue
        fitting = [c for c, used in enumerate(taken) if not (used & pattern[:, j]).any()]
        if not fitting:
            taken.append(np.zeros(len(pattern), bool))
        c = fitting[0] if fitting else len(taken) - 1
        taken[c] = taken[c] | pattern[:, j]
        colour[j] = len(alone) + c
    return colour


def gradient(function: Callable) -> Callable:
    """Return the function whose value is the gradient, like x (n,), of a number: as `jax.grad`."""
    return lambda x, *args: value_and_gradient(function)(x, *args)[1]


def value_and_gradient(function: Callable) -> Callable:
    """Return the function whose values are a number and its gradient in the first argument (n,).

    By reverse mode, as `jax.value_and_grad`; by forward mode where reverse mode cannot go through.
    """

    def evaluate(x, *args):
        closed, traced = _trace(function, x, *args)
        if _reversible(closed, traced, x, *args):
            return jax.value_and_grad(traced)(x, *args)
        return traced(x, *args), jax.jacfwd(traced)(x, *args)

    return evaluate


def reversible(function: Callable, x, *args) -> bool:
    """Tell whether reverse mode can differentiate a function by its first argument, a pytree."""
    return _reversible(*_trace(function, x, *args), x, *args)


def _reversible(closed: Any, function: Callable, x, *args) -> bool:
    # A loop may be harmless: in a rule of its own, or independent of x. JAX knows.
    return not _has(closed.jaxpr, _FORWARD) or _transposes(function, x, *args)


def _transposes(function: Callable, x, *args) -> bool:
    def pull_back(x, *args):
        out, pull = jax.vjp(lambda x: function(x, *args), x)
        return pull(out)

    try:
        jax.eval_shape(pull_back, *_shapes(x, *args))
    except Exception:  # no class of its own tells this error from others
        return False
    return True


def _has(jaxpr: Any, names: set[str]) -> bool:
    """Tell whether one of these operations is in a jaxpr, or in one within it."""
    kinds = jex.core.ClosedJaxpr | jex.core.Jaxpr
    for equation in jaxpr.eqns:
        inner = jax.tree.leaves(equation.params, is_leaf=lambda leaf: isinstance(leaf, kinds))
        bodies = [getattr(leaf, "jaxpr", leaf) for leaf in inner if isinstance(leaf, kinds)]
        if equation.primitive.name in names or any(_has(body, names) for body in bodies):
            return True
    return False


def push_forward(function: Callable, x, tangents):
    """Return a function's value and tangents at the pytree x; a tangent of None is zero.

    To transpose the tangents, as reverse mode does, raises RuntimeError with what is missing where
    a loop makes it impossible.
    """
    moved = jax.tree.map(lambda _, t: t is not None, x, tangents)
    moving, resting = eqx.partition(x, moved)
    some = lambda moving: function(eqx.combine(moving, resting))  # noqa: E731
    closed, traced = _trace(some, moving)
    out, pushed = jax.jvp(traced, (moving,), (tangents,))
    if not _reversible(closed, traced, moving):
        message = f"{NO_REVERSE}; jax.jvp and jax.jacfwd work"
        pushed = nondifferentiable_backward(pushed, msg=message)
    return out, pushed


def _shapes(*args):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), args)


def _trace(function: Callable, *args) -> tuple[Any, Callable]:
    """Return a function's jaxpr and the same function with all that is Python left out.

    To differentiate the latter takes a fraction of the time: what the function differentiates
    itself is differentiated already.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*_shapes(*args))
    flat, tree = jex.core.jaxpr_as_fun(closed), jax.tree.structure(shape)

    def traced(*args):
        leaves = map(jnp.asarray, jax.tree.leaves(args))
        return jax.tree.unflatten(tree, flat(*leaves))

    return closed, traced


def dependence(function: Callable, x, *args) -> np.ndarray:
    """Return which outputs (n,) of a function may depend on which entries of x (m,): bool (n, m).

    Operations that are not known here count as mixing everything.
    """
    return _pattern(_trace(function, x, *args)[0], jnp.shape(x)[0], len(args))


def _pattern(closed: Any, m: int, others: int) -> np.ndarray:
    out = _follow(closed, [np.eye(m, dtype=bool), *([None] * others)], m)[0]
    shape = (*closed.out_avals[0].shape, m)
    return np.zeros(shape, bool) if out is None else np.broadcast_to(out, shape)


def _follow(
    closed: Any,
    inputs: Sequence[np.ndarray | None],
    m: int,
    stops: bool = True,
    values: Sequence[np.ndarray | None] = (),
) -> list[np.ndarray | None]:
    """Propagate dependences, of shape (*variable, m) or None for none, through a jaxpr.

    Without `stops`, a `stop_gradient` stops nothing, as within what has a derivative of its own.
    `values` are those of inputs that are constants, None for others.
    """
    jaxpr = getattr(closed, "jaxpr", closed)
    known: dict[Any, np.ndarray | None] = dict(zip(jaxpr.invars, inputs, strict=True))
    fixed = dict(zip(jaxpr.invars, values, strict=False))
    fixed |= dict(zip(jaxpr.constvars, map(_value, getattr(closed, "consts", ())), strict=False))

    def read(var):
        return None if isinstance(var, jex.core.Literal) else known.get(var)

    def value(var):
        return _value(var.val) if isinstance(var, jex.core.Literal) else fixed.get(var)

    for equation in jaxpr.eqns:
        given, constants = ([look(var) for var in equation.invars] for look in (read, value))
        if all(g is None for g in given):
            if equation.primitive.name in _KEEPING:
                fixed[equation.outvars[0]] = constants[0]
            continue
        outs = _through(equation, given, m, stops, constants)
        known.update(zip(equation.outvars, outs, strict=True))
    return [read(var) for var in jaxpr.outvars]


def _value(constant: Any) -> np.ndarray | None:
    """Return what a constant is, where it is a mask that can be known."""
    mask = getattr(constant, "dtype", None) == np.bool_
    if isinstance(constant, jax.core.Tracer) or not mask:
        return None
    return np.asarray(constant)


def _through(
    equation: Any,
    given: list[np.ndarray | None],
    m: int,
    stops: bool,
    values: list[np.ndarray | None],
) -> list[np.ndarray | None]:
    """Propagate dependences through one operation."""
    name, params = equation.primitive.name, equation.params
    shapes = [var.aval.shape for var in equation.outvars]
    inner = [v for v in params.values() if isinstance(v, jex.core.ClosedJaxpr | jex.core.Jaxpr)]
    if name == "stop_gradient" and not stops:
        return given
    if name in _CONSTANT:
        return [None] * len(shapes)
    if name == "select_n" and values[0] is not None and values[0].shape == shapes[0]:
        cases = [np.zeros((*shapes[0], m), bool) if g is None else g for g in given[1:]]
        return [np.where(values[0][..., None], cases[1], cases[0])]
    if name in _ELEMENTWISE:
        parts = [np.broadcast_to(g, (*shapes[0], m)) for g in given if g is not None]
        return [np.any(parts, axis=0)]
    if name in _REDUCING:
        return [given[0].any(axis=tuple(params["axes"]))]  # pyright: ignore
    if name in _MOVING:
        return _moved(equation, given, m)
    if name == "dot_general":
        return [_product(equation, given, m)]
    if len(inner) == 1 and name not in ("scan", "while", "cond"):
        jaxpr = getattr(inner[0], "jaxpr", inner[0])
        if len(jaxpr.invars) == len(given):
            # The derivative that a function states itself is not that of what it computes.
            own = name.startswith("custom_")
            outs = _follow(inner[0], given, m, stops and not own, values)
            if not own or all(out is not None for out in outs):
                return outs
    anything = np.any([g.reshape(-1, m).any(axis=0) for g in given if g is not None], axis=0)
    return [np.broadcast_to(anything, (*shape, m)) for shape in shapes]


def _moved(equation: Any, given: list[np.ndarray | None], m: int) -> list[np.ndarray | None]:
    """Follow operations that only move elements, by moving their numbers."""
    numbers, tables, count = [], [], 0
    for var, g in zip(equation.invars, given, strict=True):
        shape = var.aval.shape
        size = int(np.prod(shape))
        numbers.append(np.arange(count, count + size).reshape(shape))
        tables.append(np.zeros((size, m), bool) if g is None else g.reshape(size, m))
        count += size
    table = np.concatenate(tables)
    return [table[out] for out in _MOVING[equation.primitive.name](equation.params, *numbers)]


def _broadcast(params: dict[str, Any], a: np.ndarray) -> list[np.ndarray]:
    shape, dims = params["shape"], params["broadcast_dimensions"]
    sizes = [a.shape[dims.index(d)] if d in dims else 1 for d in range(len(shape))]
    return [np.broadcast_to(a.reshape(sizes), shape)]


def _slice(params: dict[str, Any], a: np.ndarray) -> list[np.ndarray]:
    strides = params["strides"] or [1] * a.ndim
    ranges = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [a[tuple(slice(*range) for range in ranges)]]


# In NumPy: computed by JAX, each would be compiled for its shapes, at 20 ms.
_MOVING = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *parts: [np.concatenate(parts, params["dimension"])],
    "reshape": lambda params, a: [a.reshape(params["new_sizes"])],
    "rev": lambda params, a: [np.flip(a, params["dimensions"])],
    "slice": _slice,
    "split": lambda params, a: np.split(a, np.cumsum(params["sizes"])[:-1], params["axis"]),
    "stack": lambda params, *parts: [np.stack(parts, params["axis"])],
    "squeeze": lambda params, a: [a.squeeze(params["dimensions"])],
    "transpose": lambda params, a: [a.transpose(params["permutation"])],
}


def _product(equation: Any, given: list[np.ndarray | None], m: int) -> np.ndarray:
    """Follow a product: an output depends on its row of the left and its column of the right."""
    contracted, batched = equation.params["dimension_numbers"]
    shape = equation.outvars[0].aval.shape
    out = np.zeros((*shape, m), bool)
    free_before = 0
    for i, g in enumerate(given):
        rank = len(equation.invars[i].aval.shape)
        free = [d for d in range(rank) if d not in contracted[i] and d not in batched[i]]
        if g is not None:
            g = g.any(axis=tuple(contracted[i]), keepdims=True)
            g = np.transpose(g, (*batched[i], *free, *contracted[i], rank))
            g = g.reshape(*g.shape[: len(batched[i]) + len(free)], m)
            lead, ahead = len(batched[i]), [1] * free_before
            behind = [1] * (len(shape) - lead - free_before - len(free))
            out |= g.reshape(*g.shape[:lead], *ahead, *g.shape[lead:-1], *behind, m)
        free_before += len(free)
    return out
