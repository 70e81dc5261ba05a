"""What a function's code names and writes to, and whether it is the user's own."""

import dis
import functools
import site
import sys
import sysconfig
import types
import weakref
from pathlib import Path
from typing import Any, NamedTuple

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
SELF, ITEM = "", "[]"  # in a path: a function's first argument, and an item of what comes before
Way = tuple[str, ...]
_CACHE: "weakref.WeakKeyDictionary[types.CodeType, Uses]" = weakref.WeakKeyDictionary()


class Uses(NamedTuple):
    """Names of globals and attributes that code reads, and paths to what it writes to.

    A path begins with a global, a free variable or `SELF`, and goes on by attributes and `ITEM`s.
    """

    globals: tuple[str, ...]
    attributes: frozenset[str]
    rebound: frozenset[Way]  # names and attributes that are given other values
    changed: frozenset[Way]  # what has items set, or a method called that is named like a list's


@functools.cache
def is_own(place: str) -> bool:
    """Tell whether code, given by its file or by its module's name, is no installed package's."""
    path = Path(place)
    # A file may have the name of a standard module.
    module = "" if path.suffix == ".py" else place.split(".")[0]
    if place.startswith("<frozen") or module in sys.stdlib_module_names:
        return False
    if not {"site-packages", "dist-packages"}.isdisjoint(path.parts):
        return False
    return not any(path.is_relative_to(installed) for installed in _INSTALLED)


def reads(code: types.CodeType) -> Uses:
    """Return what code uses, that of functions within it included."""
    if code not in _CACHE:
        _CACHE[code] = _uses(code)
    return _CACHE[code]


def _uses(code: types.CodeType) -> Uses:
    scan = _Scan(code)
    for instruction in dis.get_instructions(code):
        scan.step(instruction)
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            scan.within(reads(inner))
    rebound, changed = frozenset(scan.rebound), frozenset(scan.changed)
    return Uses(tuple(scan.names), frozenset(scan.attributes), rebound, changed)


class _Scan:
    """Going through code, instruction by instruction."""

    def __init__(self, code: types.CodeType):
        self.code = code
        self.first = code.co_varnames[0] if code.co_argcount else None
        self.names: dict[str, None] = {}
        self.attributes: set[str] = set()
        self.rebound: set[Way] = set()
        self.changed: set[Way] = set()
        self.paths: dict = {}  # where an expression begins -> the path to its value so far
        self.before: dict = {}  # an attribute's whole place -> the path to what it is of
        self.last: Way = ()  # to what the instruction before has put onto the stack

    def step(self, instruction: dis.Instruction) -> None:
        """Look at an instruction; a path of () is one that is not known."""
        op, name = instruction.opname, instruction.argval
        whole: Any = tuple(instruction.positions or (None,))
        whole = instruction.offset if None in whole else whole
        place = whole if isinstance(whole, int) else whole[0::2]
        on, self.last = self.last or self.paths.get(place, ()), ()
        if op.startswith(("LOAD_GLOBAL", "LOAD_NAME")):
            self.names[name] = None
        if op.startswith(("LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF", "LOAD_FAST")):
            self.last = self.paths[place] = self._root(op, name)
        elif op.startswith(("LOAD_ATTR", "LOAD_METHOD")):
            self.attributes.add(name)
            if name in _CHANGES and on:
                self.changed.add(on)
            self.before[whole] = on
            self.last = self.paths[place] = (*on, name) if on else ()
        elif op == "BINARY_SUBSCR" or (op == "BINARY_OP" and instruction.argrepr == ITEM):
            on = self.paths.get(place, ())
            self.last = self.paths[place] = (*on, ITEM) if on else ()
        elif op.startswith("CALL"):  # whose value is another
            self.paths.pop(place, None)
        elif op == "COPY":
            self.last = on
        elif op in ("STORE_SUBSCR", "DELETE_SUBSCR") and self.paths.get(place):
            self.changed.add(self.paths[place])
        elif op == "STORE_ATTR":
            on = self.before.get(whole, on)  # `a.b += 1` has looked a.b up
            self.rebound |= {(*on, name)} if on else set()
        elif op == "STORE_GLOBAL" or (op == "STORE_DEREF" and name in self.code.co_freevars):
            self.rebound.add((name,))

    def _root(self, op: str, name: Any) -> Way:
        name = name[-1] if isinstance(name, tuple) else name  # two loads in one
        if name == self.first:
            return (SELF,)
        seen = op.startswith(("LOAD_GLOBAL", "LOAD_NAME")) or name in self.code.co_freevars
        return (name,) if seen else ()

    def within(self, uses: Uses) -> None:
        """Add what a function within this one uses, but for what it writes to its own or here."""
        self.names.update(dict.fromkeys(uses.globals))
        self.attributes |= uses.attributes
        self.rebound |= {self._outer(path) for path in uses.rebound} - {(), (SELF,)}
        self.changed |= {self._outer(path) for path in uses.changed} - {()}

    def _outer(self, path: Way) -> Way:
        if path[0] in self.code.co_cellvars:
            return (SELF, *path[1:]) if path[0] == self.first else ()
        return path if path[0] != SELF else ()
