"""What a function's code names and writes to, and whether it is the user's own."""

import dis
import functools
import site
import sys
import sysconfig
import types
import weakref
from pathlib import Path
from typing import NamedTuple

# fmt: off
_CHANGES = frozenset((
    "append", "add", "extend", "update", "insert", "setdefault", "pop", "popitem", "remove",
    "discard", "clear", "appendleft",
))
# fmt: on
_INSTALLED = tuple(
    {
        *(path for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib"))),
        *site.getsitepackages(),
        str(Path(__file__).parent),
    }
)
_CACHE: "weakref.WeakKeyDictionary[types.CodeType, Uses]" = weakref.WeakKeyDictionary()


class Uses(NamedTuple):
    """Names of globals and attributes that code reads, and names of what it writes to."""

    globals: tuple[str, ...]
    attributes: frozenset[str]
    written: frozenset[str]


@functools.cache
def is_own(place: str) -> bool:
    """Tell whether code, given by its file or by its module's name, is no installed package's."""
    if place.startswith("<frozen") or place.split(".")[0] in sys.stdlib_module_names:
        return False
    installed = "site-packages" in place or "dist-packages" in place
    return not installed and not place.startswith(_INSTALLED)


def reads(code: types.CodeType) -> Uses:
    """Return what code uses, that of functions within it included."""
    if code not in _CACHE:
        _CACHE[code] = _uses(code)
    return _CACHE[code]


def _uses(code: types.CodeType) -> Uses:
    names: dict[str, None] = {}
    attributes: set[str] = set()
    written: set[str | None] = set()
    containers: dict = {}  # where an expression begins -> the name that it begins with
    last = None
    for instruction in dis.get_instructions(code):
        op, name = instruction.opname, instruction.argval
        place = (instruction.positions or (None,))[0::2]  # where its expression begins
        if op.startswith(("LOAD_GLOBAL", "LOAD_NAME")):
            names[name] = None
        if op.startswith(("LOAD_ATTR", "LOAD_METHOD")):
            attributes.add(name)
            if name in _CHANGES:
                written.add(last)
        if op in ("STORE_GLOBAL", "STORE_ATTR") or (
            op == "STORE_DEREF" and name in code.co_freevars
        ):
            written.add(name)
        if op == "STORE_SUBSCR" and None not in place:
            written.add(containers.get(place))
        if op.startswith("LOAD_") and op != "LOAD_CONST" and isinstance(name, str):
            containers[place] = last = name
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            uses = reads(inner)
            names.update(dict.fromkeys(uses.globals))
            attributes |= uses.attributes
            written |= uses.written
    return Uses(tuple(names), frozenset(attributes), frozenset(name for name in written if name))
