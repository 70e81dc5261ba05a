"""How programs of the library are compiled: for the world that they see, by JAX's own rules."""

import contextlib
import functools
from collections.abc import Callable

import equinox as eqx
import jax

from ._closure import read_classes


class _Seen:
    """What the methods of the user's classes depend on, for a jit to compare."""

    def __init__(self, key: tuple):
        self.key = key

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Seen) and self.key == other.key


def jit(function: Callable) -> Callable:
    """Return `eqx.filter_jit(function)` with two differences.

    It traces again when a class of the user's sees another world: when a global that one of its
    methods names, or a number of the class itself, has changed. And it is traced by JAX's own
    rules: an application that has JAX refuse promotions of ranks and dtypes, or NaN, means its
    own code. Here NaN is an answer: it fills the history, and statuses tell of any other.
    """

    def traced(seen, *args, **kwargs):
        return function(*args, **kwargs)

    traced.__name__ = function.__name__
    compiled = eqx.filter_jit(traced)

    @functools.wraps(function)
    def call(*args, **kwargs):
        with own_rules():
            return compiled(_Seen(read_classes((args, kwargs))), *args, **kwargs)

    call._cached = compiled._cached  # pyright: ignore[reportAttributeAccessIssue, reportFunctionMemberAccess]
    return call


@contextlib.contextmanager
def own_rules():
    """Trace what is within by JAX's default rules, whatever the application has set."""
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.debug_nans(False),
    ):
        yield
