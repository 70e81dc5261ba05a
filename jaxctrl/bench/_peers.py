"""The programs that the solvers are compared with. They are in the repository, not in the wheel."""

import importlib
import sys
from pathlib import Path
from types import ModuleType


class Absent(Exception):
    """Report that the other programs are not here, and where they are to be had."""


def folder() -> Path:
    """Return the folder `benchmarks` of the checkout: of this package's, or the working folder.

    Raises: Absent.
    """
    for root in (Path(__file__).resolve().parents[2], Path.cwd()):
        if (root / "benchmarks" / "peers" / "suite.py").is_file():
            return root / "benchmarks"
    raise Absent(
        "the peers are no part of the installed package: they are in the folder benchmarks/ of "
        "jaxctrl's source repository (or source distribution); run this command in there, where "
        f"benchmarks/ is, not in {Path.cwd()}"
    )


def load(name: str) -> ModuleType:
    """Import a module of benchmarks/peers.

    Raises: Absent.
    """
    place = str(folder())
    if place not in sys.path:
        sys.path.insert(0, place)
    return importlib.import_module(f"peers.{name}")
