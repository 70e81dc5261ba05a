"""An experiment in a file of a user's own: a module with the same four names as the registry's."""

import ast
import contextlib
import dataclasses
import difflib
import hashlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

PARTS = {
    "Config": "a frozen dataclass with a class method quick()",
    "run": "run(config) -> jc.experiments.Result",
    "figure": "figure(result) -> matplotlib Figure",
    "claims": "claims(result) -> list of jc.experiments.Claim",
}
"""What an experiment defines."""


class FileError(ValueError):
    """Report a file that is no experiment: its path and what is wrong with it."""


def is_file(word: str) -> bool:
    """Tell whether a word names a file, and no experiment of the registry."""
    return word.endswith(".py")


def check(word: str, taken: Iterable[str]) -> None:
    """Raise a FileError for a file that does not exist or has the name of another experiment.

    Arguments:
        word: path of the file.
        taken: names that it must not have, because its results lie in a folder of its own name.
    """
    path, taken = Path(word), list(taken)
    if path.stem in taken and path.is_file():
        raise FileError(
            f"{path}: its results would be called {path.stem!r}, as another experiment's are: "
            "give the file another name"
        )
    if not path.is_file():
        near = difflib.get_close_matches(path.stem, taken, n=1)
        files = difflib.get_close_matches(path.name, [p.name for p in path.parent.glob("*.py")], 1)
        advice = [repr(str(path.parent / name)) for name in files]
        advice += [f"the experiment {name!r}" for name in near]
        hint = f"; did you mean {' or '.join(advice)}?" if advice else ""
        raise FileError(f"{path}: there is no such file{hint}")


def load(word: str) -> ModuleType:
    """Import an experiment's file, as a script that can import what lies beside it.

    Raises: FileError naming what it lacks; whatever the file itself raises passes through.
    """
    path = Path(word).resolve()
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    name = f"jaxctrl_experiment_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their annotations up there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    for part, what in PARTS.items():
        if not callable(getattr(module, part, None)):
            raise FileError(f"{word}: has no {part}; an experiment defines {what}")
    if not dataclasses.is_dataclass(module.Config):
        raise FileError(f"{word}: its Config is no dataclass; {PARTS['Config']} is wanted")
    return module


def describe(word: str) -> str:
    """Return the first line of a file's docstring, or nothing, without running it."""
    with contextlib.suppress(OSError, SyntaxError, ValueError):
        text = ast.get_docstring(ast.parse(Path(word).read_text(encoding="utf-8")))
        return (text or "").partition("\n")[0]
    return ""


def fingerprint(word: str) -> dict[str, str]:
    """Return a file's name with the beginning of its SHA-256, for the record of what was run."""
    return {Path(word).name: hashlib.sha256(Path(word).read_bytes()).hexdigest()[:16]}
