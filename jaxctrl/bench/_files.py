"""The file of a run: written whole or not at all, and refused when it cannot be trusted."""

import contextlib
import datetime
import importlib.metadata
import json
import math
import os
import platform
import tempfile
from pathlib import Path
from typing import Any

from ..stopwatch import CORES

SCHEMA = 1
"""Number of the file's layout; a file of another number is refused."""
PACKAGES = ("jaxctrl", "jax", "jaxlib", "numpy", "scipy", "casadi", "crocoddyl")
_LISTS = ("suites", "rows")


class FileError(Exception):
    """Report a file that cannot be written or be trusted: its path and the reason."""


def incomplete(path: Path) -> Path:
    """Return the file that holds a run to be saved at `path` until it is complete."""
    return path.with_name(f"{path.name}.incomplete")


def machine() -> dict[str, Any]:
    """Describe where this runs."""
    cores = len(CORES) or os.cpu_count()
    return {"system": platform.platform(), "processor": _processor(), "cores": cores}


def _processor() -> str:
    """Return the processor's name as far as the system tells it."""
    described = Path("/proc/cpuinfo")
    if described.is_file():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that are there."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def header(suites: list[str], quick: bool) -> dict[str, Any]:
    """Return what a file says of a run before anything is measured."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {
        "schema": SCHEMA, "date": now, "suites": suites, "quick": quick, "complete": False,
        "machine": machine(), "versions": versions(), "rows": [], "missing": {}, "failures": {},
    }  # fmt: skip


def strict(value: Any) -> Any:
    """Replace what JSON has no word for by null."""
    if isinstance(value, dict):
        return {key: strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [strict(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_writable(path: Path) -> None:
    """Raise FileError, before anything is measured, when a file cannot be written here."""
    if path.is_dir():
        raise FileError(f"{path}: is a folder, a file's name is wanted")
    if not path.parent.is_dir():
        raise FileError(f"{path}: there is no folder {path.parent}")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise FileError(f"{path}: cannot write into its folder ({error.strerror})") from error


def save(path: Path, run: dict[str, Any]) -> None:
    """Write a run into a temporary sibling, force it to the disk and rename it."""
    text = json.dumps(strict(run), indent=1, allow_nan=False) + "\n"
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def load(path: Path) -> dict[str, Any]:
    """Read a run that `save` wrote.

    Raises: FileError with the path and the reason.
    """

    def no_number(word: str):
        raise ValueError(f"{word} is no JSON")

    try:
        run = json.loads(path.read_text(encoding="utf-8"), parse_constant=no_number)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # also what is not UTF-8
        raise FileError(f"{path}: is not JSON ({error})") from error
    if not isinstance(run, dict) or any(not isinstance(run.get(k), list) for k in _LISTS):
        raise FileError(f"{path}: is not a file of `jaxctrl bench --save`")
    if run.get("schema") != SCHEMA:
        raise FileError(f"{path}: has layout {run.get('schema')}, this version reads {SCHEMA}")
    for i, row in enumerate(run["rows"]):
        timing = row.get("timing", {}) if isinstance(row, dict) else None
        if timing != {} and not _is_timing(timing):
            raise FileError(f"{path}: row {i} is damaged")
    return run


def _is_timing(timing: Any) -> bool:
    """Tell whether a row's timing is what `_timing.timing` returns."""
    if not isinstance(timing, dict):
        return False
    medians = (timing.get("ms"), timing.get("cpu_ms"))
    if not all(isinstance(value, float | int) and value > 0 for value in medians):
        return False
    lists = timing.get("relative")
    return (
        isinstance(lists, list)
        and all(isinstance(rounds, list) for rounds in lists)
        and all(isinstance(v, float | int) and v > 0 for rounds in lists for v in rounds)
    )
