"""User functions as pytrees, whose leaves are the arrays that the function depends on.

A plain function is opaque to JAX: a traced number in its closure gets no gradient by the implicit
function theorem, and a changed one goes unnoticed by the cache of `jax.jit`. A `Function` is read
(`_closure.read`) each time that it is flattened: at every jit boundary, that is, at every solve.
"""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._closure import Reading, read
from ._recipe import build
from ._types import array_leaf


class _Source:
    """The user's function itself; it lives as long as a `Function` made of it does."""

    def __init__(self, function: Callable):
        self.function = function


class _Static:
    """What of a function is static: compared by its key."""

    def __init__(self, reading: Reading, source: _Source):
        self.key, self.names, self.recipe = reading.key, reading.names, reading.recipe
        # Weakly, as this stays in jit's cache, and a closure may hold tracers.
        self.source = weakref.ref(source)
        self.name = getattr(source.function, "__name__", type(source.function).__name__)
        self._hash = hash(self.key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Static) and self._hash == other._hash and self.key == other.key


@jtu.register_pytree_with_keys_class
class Function:
    """A function as a pytree: JAX arrays that it depends on are its leaves, all else is static.

    It follows the user's function, whose globals and objects may change between two uses, until one
    of its leaves is replaced; then it keeps what it was given.
    """

    def __init__(self, function: Callable):
        self._source: _Source | None = _Source(function)
        self._given: tuple[_Static, Sequence] | None = None
        self._built: Any = None

    def __call__(self, *args: Any) -> Any:
        """Return what the function returns."""
        if self._given is None:
            assert self._source is not None
            reading = read(self._source.function)
            return build(reading.recipe, reading.leaves)(*args)
        built, (static, leaves) = self._built, self._given
        self._built = built = build(static.recipe, leaves) if built is None else built
        return built(*args)

    def tree_flatten(self) -> tuple[Sequence, _Static]:
        """Return the leaves and what is static."""
        if self._given is not None:
            return self._given[1], self._given[0]
        assert self._source is not None
        reading = read(self._source.function)
        return reading.leaves, _Static(reading, self._source)

    def tree_flatten_with_keys(self) -> tuple[list, _Static]:
        """Return the leaves with their names, and what is static."""
        leaves, static = self.tree_flatten()
        return [(jtu.GetAttrKey(n), x) for n, x in zip(static.names, leaves, strict=True)], static

    @classmethod
    def tree_unflatten(cls, static: _Static, leaves: Sequence) -> "Function":
        """Return the function with these leaves; the user's own where they are its own."""
        new = object.__new__(cls)
        new._source, new._given, new._built = static.source(), (static, leaves), None
        if new._source is not None:
            now = read(new._source.function)
            same = len(now.leaves) == len(leaves) and all(map(_is, now.leaves, leaves))
            if same and now.key == static.key:
                new._given = None
        return new

    def __repr__(self) -> str:
        static = self.tree_flatten()[1]
        return f"Function({static.name})"


def _is(a: Any, b: Any) -> bool:
    return a is b


def closed(tree: Any) -> Any:
    """Return a pytree with each function in it made a `Function`; networks keep their structure."""
    if not any(map(_is_function, jtu.tree_leaves(tree))):
        return tree
    return jtu.tree_map(lambda leaf: Function(leaf) if _is_function(leaf) else leaf, tree)


def _is_function(leaf: Any) -> bool:
    return callable(leaf) and not isinstance(leaf, type)


def check_function(name: str, function: Any) -> Any:
    """Return a function, or a callable pytree, `closed`; raises TypeError naming the argument."""
    if not callable(function) or isinstance(function, type):
        hint = f"; write {function.__name__}(...)" if isinstance(function, type) else ""
        raise TypeError(f"{name}: a function is wanted, got {function!r}{hint}")
    return closed(function)


def describe(owner: Any) -> str:
    """Name the class of a plant or a cost, and the functions in it."""
    nodes = jtu.tree_leaves(owner, is_leaf=lambda node: isinstance(node, Function))
    names = [repr(node) for node in nodes if isinstance(node, Function)]
    return type(owner).__name__ + (f" of {', '.join(names)}" if names else "")


def as_params(params: Any) -> Any:
    """Return a pytree of arrays and functions, such as a network, with its numbers as arrays.

    Python numbers become floating arrays, as everywhere in jaxctrl, so that they have a gradient;
    integer and boolean arrays stay what they are.

    Raises TypeError, naming where, for anything else.
    """

    def leaf(path, value):
        if _is_function(value):
            return Function(value)
        try:
            return _param(value)
        except TypeError as error:
            raise TypeError(f"params{jtu.keystr(path)}: {error}") from None

    return jtu.tree_map_with_path(leaf, params)


def _param(value: Any) -> jax.Array:
    if isinstance(value, str | bytes | type):
        raise TypeError(
            f"an array or a number is wanted, got {value!r}; what is no number, the function may "
            "close over"
        )
    dtype = getattr(value, "dtype", None)
    whole = dtype is not None and not jnp.issubdtype(dtype, jnp.inexact)  # PRNG keys too
    return jnp.asarray(value) if whole or isinstance(value, bool) else array_leaf(value)
