"""What every public function asks of its arguments, wherever their values can be known."""

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ._types import array_leaf


def is_concrete(*arrays) -> bool:
    """Tell whether no array is a tracer, so that its values may be looked at."""
    return not any(isinstance(array, jax.core.Tracer) for array in arrays)


def known(*values: ArrayLike) -> np.ndarray | None:
    """Return the values as one NumPy array, or None when one of them is a tracer or no number."""
    try:
        return np.asarray(values[0] if len(values) == 1 else values, dtype=float)
    except (TypeError, ValueError):  # what JAX raises for tracers; what is no number fails later
        return None


def check_integer(name: str, value: Any, minimum: int) -> int:
    """Return `value` as an int: Python's or NumPy's, of at least `minimum`.

    Raises TypeError (floats, booleans, tracers) or ValueError, naming the argument.
    """
    try:
        number = operator.index(value)
    except Exception:  # tracers raise one of JAX's own
        number = None
    if number is None or isinstance(value, bool):
        raise TypeError(f"{name}: an integer is wanted, got {value!r}")
    if number < minimum:
        raise ValueError(f"{name}: at least {minimum} is wanted, got {number}")
    return number


def check_instance(name: str, value: Any, kind: Any, wanted: str) -> None:
    """Raise TypeError, naming the argument, when `value` is no `kind`; `wanted` says what is."""
    if isinstance(value, kind):
        return
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(
            f"{name}: got the class {value.__name__}; write {value.__name__}() with parentheses"
        )
    raise TypeError(f"{name}: {wanted}, got {value!r}")


def shape_of(value: Any) -> tuple[int, ...]:
    """Return the shape of what may be an array; () for what is none."""
    try:
        return np.shape(value)
    except ValueError:  # a ragged list
        return ()


def check_array(name: str, value: ArrayLike, shape: tuple[int, ...], hint: str = "") -> Array:
    """Return `value` as a floating array of `shape`, finite where that can be known.

    Raises ValueError (shape, non-finite) or TypeError (no real numbers), naming the argument.
    """
    if value is None or (isinstance(value, Callable) and not hasattr(value, "shape")):
        kind = "None" if value is None else f"the function {value!r}"
        raise TypeError(f"{name}: an array of shape {shape} is wanted, got {kind}")
    array = array_leaf(value, name)
    if array.shape != shape:
        raise ValueError(
            f"{name}: got shape {array.shape}, wanted {shape}" + (hint and f"; {hint}")
        )
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        bad = np.argwhere(~np.isfinite(np.asarray(array)))[0]
        raise ValueError(f"{name}: not finite at index {tuple(int(i) for i in bad)}")
    return array


def parameter(
    name: str, value: ArrayLike, shape: tuple[int, ...] = (), *, minimum: float | None = None
) -> Array:
    """Return `value` as a floating array broadcast to `shape`.

    Raises TypeError for what is no number; ValueError, naming the argument, for another shape than
    () or `shape`, and for a known value that is not finite or below `minimum`.
    """
    array = array_leaf(value, name)
    if array.shape not in ((), shape):
        raise ValueError(f"{name}: shape {array.shape}, wanted {wanted(shape)}")
    numbers = known(value)
    if numbers is not None:
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: finite numbers are wanted, got {value}")
        if minimum is not None and (numbers < minimum).any():
            raise ValueError(f"{name}: at least {minimum:g} is wanted, got {value}")
    return jnp.broadcast_to(array, shape)


def positive(name: str, value: ArrayLike, shape: tuple[int, ...] = ()) -> Array:
    """Return `value` as `parameter` does.

    Raises ValueError, naming the argument, where a known value is not above zero.
    """
    numbers = known(value)
    if numbers is not None and not (numbers > 0).all():
        raise ValueError(f"{name}: positive numbers are wanted, got {value}")
    return parameter(name, value, shape)


def check_radians(name: str, angles: ArrayLike) -> None:
    """Raise ValueError, naming the argument, where a finite angle is known to be over two turns."""
    numbers = known(angles)
    if numbers is not None and (np.isfinite(numbers) & (np.abs(numbers) > 4 * np.pi)).any():
        raise ValueError(f"{name}: {angles} is more than two turns; are these radians?")


def wanted(shape: tuple[int, ...]) -> str:
    """Write the shapes that `parameter` accepts."""
    return "()" if shape == () else f"() or {shape}"


def check_weights(**weights: ArrayLike) -> None:
    """Raise ValueError or TypeError, naming the argument, for a weight known to be negative."""
    for name, value in weights.items():
        array = array_leaf(value, name)
        if not array.size:
            raise ValueError(f"{name}: got no number, shape {array.shape}")
        numbers = known(value)
        if numbers is not None and not (numbers >= 0).all():
            raise ValueError(f"{name}: at least 0 is wanted, got {value}")


_MARK = "_jaxctrl_checked"


def is_checked(module: eqx.Module) -> bool:
    """Tell whether this very object was found right before; whatever is edited is another one."""
    return _MARK in vars(module)


def mark_checked(module: eqx.Module) -> None:
    """Remember that an object was found right, where nothing in it can change."""
    leaves = jax.tree.leaves(module)
    if all(isinstance(leaf, jax.Array) for leaf in leaves) and is_concrete(*leaves):
        object.__setattr__(module, _MARK, True)


def converted(tree: Any) -> Any:
    """Return a pytree in which fields that are arrays, or have a converter, hold arrays again.

    What `tree_at` puts there stays as it is: a Python number would be a constant, with which each
    new value compiles anew, and which has no gradient.
    """
    if not any(map(_is_number, jax.tree.leaves(tree))):
        return tree

    def visit(node: Any) -> Any:
        return _converted_module(node, visit) if isinstance(node, eqx.Module) else node

    return jax.tree.map(visit, tree, is_leaf=lambda node: isinstance(node, eqx.Module))


def _converted_module(module: eqx.Module, visit: Callable) -> eqx.Module:
    fields = {field.name: field for field in dataclasses.fields(module)}  # pyright: ignore[reportArgumentType]
    values = dict(vars(module))
    for name, field in fields.items():
        static = name not in values or field.metadata.get("static", False)
        if static or not any(map(_is_number, jax.tree.leaves(values[name]))):
            continue
        new = jax.tree.map(visit, values[name], is_leaf=lambda v: isinstance(v, eqx.Module))
        if any(map(_is_number, jax.tree.leaves(new))):
            of_array = field.type is jax.Array or hasattr(field.type, "array_type")
            named = functools.partial(array_leaf, name=name) if of_array else None
            convert = field.metadata.get("converter", named)
            new = new if convert is None else convert(new)
        values[name] = new
    copy = object.__new__(type(module))
    for name, value in values.items():
        object.__setattr__(copy, name, value)
    return copy


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, float | int | str | np.ndarray | np.generic)


def check_again(tree: Any) -> None:
    """Make every Equinox module within a pytree check itself again, as after `tree_at`."""
    modules = []

    def visit(node) -> bool:
        if isinstance(node, eqx.Module):
            modules.append(node)
        return False

    jax.tree.flatten(tree, is_leaf=visit)
    for module in modules:
        for kind in type(module).__mro__:
            if "__check_init__" in vars(kind):
                vars(kind)["__check_init__"](module)
