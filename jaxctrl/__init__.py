"""Differentiable optimal control of biological and robotic movement, in JAX.

A `Problem` (plant, cost, noise, bounds, time grid) goes through a solver and comes out as a
`Solution`, whose policy `simulate` runs. Submodules: `plants`, `tasks`, `problems`, `models`,
`analysis`, `linear`, `plot`, `experiments`, `stopwatch`.

The names are listed in `__init__.pyi` alone. Each is imported when it is first used, so that the
command line answers at once, without JAX.
"""

import ast
import functools
import importlib
from pathlib import Path


@functools.cache
def _names() -> dict[str, tuple[str, str]]:
    """Read the stub: where each public name is, as a module and the name that it has there."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def __getattr__(name: str):
    if name == "__all__":
        return sorted(_names())
    if name not in _names():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, there = _names()[name]
    found = importlib.import_module(f"{__name__}.{module or there}")
    value = getattr(found, there) if module else found
    globals()[name] = value
    return value


def __dir__():
    return sorted(_names())
