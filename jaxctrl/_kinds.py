"""Which values a function's reader looks into, and how."""

import argparse
import collections
import enum
import sys
import types
from typing import Any

import jax
import numpy as np

from ._bytecode import SELF, Way, is_own

COUNTS = bool | int | float | str | None
LOGS = list | dict | set | bytearray | collections.deque
DATA = complex | bytes | COUNTS | np.ndarray | np.generic | jax.Array | tuple | LOGS | frozenset
# Containers that are no pytrees, or not where their class is derived from.
HOLDERS = dict | list | tuple | types.MappingProxyType | collections.deque | bytearray
NAMESPACES = (types.SimpleNamespace, argparse.Namespace)
RULES = (jax.custom_jvp, jax.custom_vjp)


def has_parts(value: Any) -> bool:
    return not isinstance(value, enum.Enum) and any(True for _ in attributes(value))


def attributes(value: Any):
    """Yield the names and values of an object's attributes."""
    for base in type(value).__mro__:
        slots = vars(base).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                yield name, getattr(value, name)
    yield from getattr(value, "__dict__", {}).items()


def find(way: Way, module: dict, cells: dict[str, types.CellType], owner: Any) -> Any:
    """Return the value to which a path leads, None where it is not known."""
    root, *names = way
    value = owner if root == SELF else module.get(root)
    if root in cells:
        try:
            value = cells[root].cell_contents
        except ValueError:  # a name that has no value yet
            return None
    for name in names:  # without running properties
        value = dict(attributes(value)).get(name)
    return value


def is_log(value: Any) -> bool:
    """Tell whether a value is a container of Python's own kinds; the user's are looked into."""
    return isinstance(value, LOGS) and not is_own_class(type(value))


def is_object(kind: type) -> bool:
    """Tell whether instances of a class are looked into: the user's plain objects."""
    if kind in NAMESPACES or kind in RULES:
        return True
    plain = kind.__new__ is object.__new__ and not issubclass(kind, type | enum.Enum)
    return plain and is_own_class(kind)


def is_own_class(kind: type) -> bool:
    module = sys.modules.get(kind.__module__)
    return is_own(getattr(module, "__file__", None) or kind.__module__)
