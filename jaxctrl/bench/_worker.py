"""One process that measures: orders come as JSON on the standard input, figures leave as lines.

Each line on the standard output is one record in JSON. A process of JAX has one dtype and compiles
loops in one manner, so a suite has as many of these processes as it needs of both.
"""

import importlib
import json
import os
import sys
import traceback
from types import ModuleType
from typing import Any, TextIO

import jax

from .._cpu import enable_fast_cpu
from . import _peers
from ._files import strict

DEVICES = 2
MODULES = {"thesis": "_thesis", "scaling": "_scaling", "problems": "_library"}


class Emitter:
    """Hand records to the parent, each with what the orders say of all of them."""

    def __init__(self, orders: dict[str, Any], stream: TextIO):
        self.common = {key: orders[key] for key in ("suite", "mode", "dtype")}
        self.stream = stream

    def __call__(self, section: str, **figures: Any) -> None:
        """Hand one record over."""
        record = strict({**self.common, "section": section, **figures})
        self.stream.write(json.dumps(record, allow_nan=False) + "\n")
        self.stream.flush()

    def failure(self, what: str, error: Exception) -> None:
        """Report a measurement that failed, and go on."""
        first = str(error).strip().partition("\n")[0]
        traceback.print_exc()
        self("failure", problem=what, reason=f"{type(error).__name__}: {first}"[:400])


def start(mode: str, dtype: str) -> None:
    """Set JAX up as the orders want it, before it is used."""
    if mode == "fast":
        if not enable_fast_cpu(DEVICES):
            sys.exit("enable_fast_cpu came too late")
    else:
        jax.config.update("jax_num_cpu_devices", DEVICES)
    jax.config.update("jax_enable_x64", dtype == "float64")
    jax.config.update("jax_enable_compilation_cache", False)  # it would hide the first calls
    jax.devices()  # before any pinning: JAX counts the cores when it starts its threads


def suite_of(name: str) -> ModuleType:
    """Import the module that measures a suite; that of the peers is in the repository."""
    if name == "peers":
        return _peers.load("suite")
    return importlib.import_module(f".{MODULES[name]}", __package__)


def main() -> None:
    """Carry out the orders."""
    stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what other programs print must not get among the records
    orders = json.load(sys.stdin)
    start(orders["mode"], orders["dtype"])
    suite_of(orders["suite"]).run(orders, Emitter(orders, stream))


if __name__ == "__main__":
    main()
