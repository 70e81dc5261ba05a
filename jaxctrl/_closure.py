"""What a plain function depends on, read out of it and put back: its closure as a list of arrays.

`read(function)` walks through everything that a function can see: its closure, its defaults, the
arguments of a `functools.partial`, the object of a bound method, and those globals that its code
names, onwards through helper functions and plain objects of the user's own code. JAX arrays, traced
ones included, are its leaves. All else is its key: numbers, strings and NumPy arrays by value, code
by code, objects of installed packages by identity. `Reading.recipe` builds the function anew with
other leaves.

What a function itself writes to (a log that it appends to, a `nonlocal` counter) is left where it
is and is no part of the key.
"""

import collections
import contextlib
import enum
import functools
import itertools
import types
from typing import Any, NamedTuple

import jax
import jax.core
import jax.tree_util as jtu
import numpy as np

from ._bytecode import ITEM, is_own, reads
from ._kinds import (
    COUNTS,
    DATA,
    HOLDERS,
    attributes,
    find,
    has_parts,
    is_log,
    is_object,
    is_own_class,
)
from ._recipe import (
    Recipe,
    keep,
    make_by,
    make_function,
    make_leaf,
    make_module,
    make_object,
    make_tree,
    whole,
)

_PLAIN = (bool, int, str, bytes, type(None), type(...), range, np.dtype)
_BY_TEXT = (float, complex)  # nan differs from itself, and 0.0 is -0.0


class Reading(NamedTuple):
    """What a function depends on: a hashable key, arrays with names, and how to put others in."""

    key: tuple
    leaves: list[jax.Array]
    names: list[str]
    recipe: Recipe


class _Same:
    """Anything, compared by identity."""

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value


class _Structure:
    """The structure of a pytree, whose static parts need not have a hash."""

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self) -> int:
        return hash((self.value.num_nodes, self.value.num_leaves))

    def __eq__(self, other: object) -> bool:
        try:
            return isinstance(other, _Structure) and bool(self.value == other.value)
        except Exception:  # static parts that cannot be compared, such as NumPy arrays
            return False


def read(function: Any) -> Reading:
    """Return what a function, a bound method or a callable object depends on."""
    walk = _Walk()
    if is_object(type(function)):
        function = function.__call__  # a bound method, whose code is looked at
    recipe = walk.value(function, "")
    return Reading(tuple(walk.key), walk.leaves, walk.names, recipe)


def read_classes(tree: Any) -> tuple:
    """Return the key of what methods depend on of those classes in a pytree that are the user's."""
    walk = _Walk()
    walk.classes(_flatten(tree)[2])
    return tuple(walk.key)


def _flatten(tree: Any) -> tuple[list, Any, list[type]]:
    """Return the leaves of a pytree, its structure, and those classes in it that are the user's."""
    kinds: dict[type, None] = {}

    def visit(node) -> bool:
        kinds[type(node)] = None
        return False

    leaves, treedef = jtu.tree_flatten(tree, is_leaf=visit)
    return leaves, treedef, [kind for kind in kinds if is_own_class(kind)]


class _Walk:
    """One walk: the key and the leaves found so far, and what was met already."""

    def __init__(self):
        self.key: list[Any] = []
        self.leaves: list[jax.Array] = []
        self.names: list[str] = []
        self.met: dict[int, Recipe] = {}
        self.alive: list[Any] = []  # so that no identity is used twice
        self.own = 0  # functions of the user's met so far
        self.rebound: set[tuple[int, str]] = set()  # variables and attributes that code writes to
        self.logs: set[int] = set()  # containers that code writes to
        self.attributes: frozenset[str] = frozenset()  # named by the code that is looked at
        self.open = True  # False within classes, whose functions cannot be given other arrays

    def value(self, value: Any, name: str) -> Recipe:
        """Look at a value that is called `name`; return how to build it."""
        kind = type(value)
        if isinstance(value, _PLAIN) and not isinstance(value, enum.Enum):
            self.key.append((kind, value))
            return keep(value)
        if kind in _BY_TEXT:
            self.key.append((kind, repr(value)))
            return keep(value)
        if isinstance(value, jax.Array) and not self.open:
            traced = isinstance(value, jax.core.Tracer)  # which a key must not keep alive
            return self._same(value) if not traced else keep(value)
        if id(value) in self.met:
            recipe = self.met[id(value)]
            self.key.append(("again", recipe.number))
            return recipe
        number = len(self.met)
        # What refers back to this meets it unfinished, but finds it made when it is built.
        self.met[id(value)] = Recipe(make_leaf, (), number)
        self.alive.append(value)
        recipe = self.met[id(value)] = self._compound(value, name)._replace(number=number)
        return recipe

    def classes(self, kinds: list[type]) -> None:
        """Look at classes, for the key alone."""
        for kind in kinds:
            self.value(kind, "")

    def _compound(self, value: Any, name: str) -> Recipe:
        if isinstance(value, jax.Array):
            self.key.append("array")
            self.leaves.append(value)
            self.names.append(name)
            return Recipe(make_leaf, (len(self.leaves) - 1,))
        if isinstance(value, np.ndarray | np.generic):
            return self._numbers(value)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if id(value) in self.logs:
            return self._same(value)
        if isinstance(value, types.MethodType):
            self._writes(value.__func__, value.__self__)
            parts = (value.__func__, value.__self__)
            return self._made_of(value, types.MethodType, parts, ("", "self"))
        if type(value) is functools.partial:
            parts = (value.func, value.args, value.keywords)
            return self._made_of(value, _partial, parts, ("", name, name))
        if type(value).__name__ == "PjitFunction":
            return self._jitted(value, name)
        if isinstance(value, types.ModuleType):
            return self._module(value, name)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, set | frozenset):
            self.key.append((type(value), frozenset(value)))
            return keep(value)
        if not jtu.all_leaves([value]):
            return self._tree(value, name)
        if is_object(type(value)):
            return self._object(value, name)
        if isinstance(value, HOLDERS) or (is_own_class(type(value)) and has_parts(value)):
            return self._hidden(value, name)
        return self._same(value)

    def _same(self, value: Any) -> Recipe:
        self.key.append(_Same(value))
        return keep(value)

    def _hidden(self, value: Any, name: str) -> Recipe:
        """Look into what is not built anew, for the key alone: containers that are no pytrees."""
        self.value(type(value), name)
        with self._closed():
            if isinstance(value, collections.deque):
                self.value(value.maxlen, name)
            if isinstance(value, dict | types.MappingProxyType):
                self.value(dict(value), name)
            elif isinstance(value, HOLDERS):
                self.value(list(value), name)
            self.value(dict(attributes(value)), name)
        return keep(value)

    @contextlib.contextmanager
    def _closed(self):
        """Look at things for the key alone, and forget after it that they were met."""
        before = self.open, self.met
        self.open, self.met = False, dict(self.met) if self.open else self.met
        yield
        self.open, self.met = before

    def _numbers(self, value: np.ndarray | np.generic) -> Recipe:
        if value.dtype.hasobject:
            return self._same(value)
        self.key.append((type(value), value.dtype, value.shape, value.tobytes()))
        return keep(value)

    def _made_of(self, value: Any, make: Any, parts: tuple, names: tuple[str, ...]) -> Recipe:
        self.key.append(make)
        found = tuple(self.value(part, name) for part, name in zip(parts, names, strict=True))
        return whole(value, found, Recipe(make_by, (make, found)))

    def _jitted(self, value: Any, name: str) -> Recipe:
        """Look through `jax.jit`: its own cache would keep what the function saw at first."""
        own = self.own
        self.key.append("jit")
        found = self.value(value.__wrapped__, name)
        if self.own == own and found.make is None:
            return keep(value)
        return Recipe(make_by, (_itself, (found,)))

    def _tree(self, value: Any, name: str) -> Recipe:
        try:
            leaves, treedef, kinds = _flatten(value)
        except Exception:  # a dictionary, here or within, whose keys have no order
            if type(value) is dict:
                parts = (tuple(value), *value.values())
                return self._made_of(value, _dictionary, parts, (name,) * len(parts))
            if isinstance(value, dict):
                return self._hidden(value, name)
            leaves, treedef = jtu.tree_flatten(value, is_leaf=lambda node: node is not value)
            kinds = [type(value)]
        self.alive.append(leaves)
        self.key.append(_Structure(treedef))
        self.classes(kinds)
        named = [name] if len(leaves) == 1 else [f"{name}[{i}]" for i in range(len(leaves))]
        found = [self.value(leaf, n) for leaf, n in zip(leaves, named, strict=True)]
        return whole(value, found, Recipe(make_tree, (treedef, found)))

    def _module(self, value: types.ModuleType, name: str) -> Recipe:
        """Look at what the code names of a module of the user's."""
        self.key.append(_Same(value))
        if not is_own(getattr(value, "__file__", None) or value.__name__):
            return keep(value)
        names = [n for n in sorted(self.attributes) if n in vars(value)]
        found = {n: self._named(vars(value)[n], value, n, _join(name, n)) for n in names}
        return whole(value, found.values(), Recipe(make_module, (value, found)))

    def _class(self, value: type) -> Recipe:
        """Look at the functions and the data of a class, for the key alone."""
        self.key.append(_Same(value))
        if not is_own_class(value):
            return keep(value)
        with self._closed():
            for base in filter(is_own_class, value.__mro__):
                for name, member in vars(base).items():
                    self._member(name, member)
        return keep(value)

    def _member(self, name: str, member: Any) -> None:
        """Look at a member of a class."""
        if isinstance(member, DATA):
            if name[:2] != "__":
                self.value(member, name)
            return
        for wrapping in ("__func__", "fget", "method"):
            member = getattr(member, wrapping, member)
        if isinstance(member, types.FunctionType):
            self.value(member, name)

    def _object(self, value: Any, name: str) -> Recipe:
        """Look at the attributes of a plain object."""
        kind = type(value)
        self.value(kind, name)
        own = dict(attributes(value))
        self.key.append(tuple(own))
        found = {n: self._named(v, value, n, _join(name, n)) for n, v in own.items()}
        return whole(value, found.values(), Recipe(make_object, (kind, found)))

    def _named(self, value: Any, holder: Any, short: str, name: str) -> Recipe:
        """Look at what a variable or an attribute holds, unless the function counts in it."""
        if (id(holder), short) in self.rebound:
            if isinstance(value, COUNTS):
                return keep(value)
            if isinstance(value, tuple) or is_log(value):
                return self._same(value)
        return self.value(value, name)

    def _writes(self, function: Any, owner: Any = None) -> None:
        """Note what a function writes to, so far as it can be found; `owner` is that of a method.

        Within classes nothing is: of their methods, those that set numbers need not be called.
        """
        if not self.open or not isinstance(function, types.FunctionType):
            return
        uses, module = reads(function.__code__), function.__globals__
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        for *way, name in uses.rebound:
            holder = find(tuple(way), module, cells, owner) if way else cells.get(name, module)
            self.rebound.add((id(holder), name))
            self.alive.append(holder)
        for way in uses.changed:
            names = tuple(itertools.takewhile(lambda name: name != ITEM, way))
            log = find(names, module, cells, owner)
            if is_log(log) and {ITEM}.issuperset(way[len(names) :]):
                self.logs.add(id(log))
                self.alive.append(log)

    def _function(self, value: types.FunctionType) -> Recipe:
        """Look at a function's closure, defaults, attributes and, if it is the user's, globals."""
        code = value.__code__
        own = is_own(code.co_filename)
        uses = reads(code)
        self.own += own
        self.key.append(code)
        self._writes(value)
        before, self.attributes = self.attributes, uses.attributes
        cells, found = [], []
        for name, cell in zip(code.co_freevars, value.__closure__ or (), strict=True):
            part = self._cell(name, cell)
            cells.append(part)
            found += [part] if isinstance(part, Recipe) else []
        defaults = [self.value(v, value.__name__) for v in value.__defaults__ or ()]
        keywords = {n: self.value(v, n) for n, v in (value.__kwdefaults__ or {}).items()}
        known = value.__globals__ if own else {}
        names = [n for n in uses.globals if n in known]
        self.key.append(tuple(names))
        globals_ = {n: self._named(known[n], known, n, n) for n in names}
        extra = {n: v for n, v in vars(value).items() if own and n != "__wrapped__"}
        extra = {n: self._named(v, value, n, n) for n, v in extra.items()}
        self.attributes = before
        found += [*defaults, *keywords.values(), *globals_.values(), *extra.values()]
        about = (code, value.__globals__, value.__name__, value.__qualname__)
        recipe = Recipe(make_function, (about, cells, defaults, keywords, globals_, extra))
        return whole(value, found, recipe)

    def _cell(self, name: str, cell: types.CellType) -> Recipe | types.CellType:
        """Look at a variable of a closure; return the cell itself where it stays as it is."""
        try:
            content = cell.cell_contents
        except ValueError:  # a name that has no value yet
            self.key.append("empty")
            return cell
        recipe = self._named(content, cell, name, name)
        return cell if recipe.make is None else recipe


def _itself(value: Any) -> Any:
    return value


def _partial(function: Any, args: tuple, keywords: dict) -> functools.partial:
    return functools.partial(function, *args, **keywords)


def _dictionary(keys: tuple, *values: Any) -> dict:
    return dict(zip(keys, values, strict=True))


def _join(name: str, attribute: str) -> str:
    return f"{name}.{attribute}" if name else attribute
