"""How a function, or an object that it sees, is built anew with other arrays in it."""

import types
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.tree_util as jtu


class Recipe(NamedTuple):
    """How to build a value: `make(build, *data)`, or `data` itself where make is None.

    No recipe holds a leaf: it may outlive the trace to which its leaves belong.
    """

    make: Any
    data: Any
    number: int = -1


class _Build:
    """Building a value from its recipe: each part once, and what refers to itself at the end."""

    def __init__(self, leaves: Sequence):
        self.leaves = leaves
        self.made: dict[int, Any] = {}
        self.later: list[Callable[[], None]] = []

    def __call__(self, recipe: Recipe) -> Any:
        if recipe.make is None:
            return recipe.data
        if recipe.number not in self.made:
            self.made[recipe.number] = recipe.make(self, *recipe.data)
        return self.made[recipe.number]

    def all(self, recipes: dict[str, Recipe]) -> dict[str, Any]:
        return {name: self(recipe) for name, recipe in recipes.items()}


def build(recipe: Recipe, leaves: Sequence) -> Any:
    """Return the value that a recipe describes, with these leaves in it."""
    making = _Build(leaves)
    value = making(recipe)
    while making.later:
        making.later.pop()()
    return value


def keep(value: Any) -> Recipe:
    return Recipe(None, value)


def make_leaf(build: _Build, i: int):
    return build.leaves[i]


def make_by(build: _Build, make, parts):
    return make(*map(build, parts))


def make_tree(build: _Build, treedef, parts):
    return jtu.tree_unflatten(treedef, [build(part) for part in parts])


def make_object(build: _Build, kind, attributes):
    new = kind() if kind is types.SimpleNamespace else object.__new__(kind)

    def fill():
        for name, value in build.all(attributes).items():
            object.__setattr__(new, name, value)

    build.later.append(fill)
    return new


def make_module(build: _Build, module, attributes):
    new = types.ModuleType(module.__name__)
    new.__dict__.update(vars(module))
    build.later.append(lambda: new.__dict__.update(build.all(attributes)))
    return new


def make_function(build: _Build, about, cells, defaults, keywords, globals_, attributes):
    code, module, name, qualname = about
    changed = {name: part for name, part in globals_.items() if part.make is not None}
    module = dict(module) if changed else module
    closure = tuple(types.CellType() if isinstance(c, Recipe) else c for c in cells)
    new = types.FunctionType(code, module, name, None, closure)
    new.__qualname__ = qualname

    def fill():
        for cell, part in zip(closure, cells, strict=True):
            if isinstance(part, Recipe):
                cell.cell_contents = build(part)
        if changed:
            module.update(build.all(changed))
        new.__defaults__ = tuple(map(build, defaults)) or None
        new.__kwdefaults__ = build.all(keywords) or None
        new.__dict__.update(build.all(attributes))

    build.later.append(fill)
    return new


def whole(value: Any, parts: Any, recipe: Recipe) -> Recipe:
    """Return the recipe, or, where all parts stay as they are, the value itself."""
    return keep(value) if all(part.make is None for part in parts) else recipe
