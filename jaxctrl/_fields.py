"""Fields of a cost that know their shape and their least value, and the check of both."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from ._checks import is_concrete

Shape = tuple[int | str, ...]


def fits(*shapes: Shape, least: float | None = None) -> dict[str, Any]:
    """Return metadata of a field that is an array of one of `shapes`, and at least `least`.

    A size may be a name: that of a size of the plant, such as "num_joints", or any other, which
    then stands for one size in all fields of the cost. Of a matrix the diagonal is compared.
    """
    return {"shapes": shapes, "least": least}


WEIGHT = fits((), least=0.0)


def _declared(part: eqx.Module) -> list[tuple[str, dict, Array]]:
    fields = [f for f in dataclasses.fields(part) if "shapes" in f.metadata]
    return [(f.name, dict(f.metadata), getattr(part, f.name)) for f in fields]


def check_numbers(part: eqx.Module) -> None:
    """Raise ValueError, naming the field, for a known value that is not finite or too small."""
    for name, given, value in _declared(part):
        if not isinstance(value, jax.Array) or not is_concrete(value):
            continue
        known, where = np.asarray(value), f"{type(part).__name__}.{name}"
        if not np.isfinite(known).all():
            raise ValueError(f"{where}: finite numbers are wanted, got {value}")
        known = np.diagonal(known, axis1=-2, axis2=-1) if known.ndim > 1 else known
        if given["least"] is not None and not (known >= given["least"]).all():
            raise ValueError(f"{where}: at least {given['least']:g} is wanted, got {value}")


def check_shapes(part: eqx.Module, plant: Any) -> None:
    """Raise ValueError, naming the field, for a shape that does not fit the plant or the others."""
    sizes: dict[str, int] = {}

    def size(name: int | str) -> int | None:
        if isinstance(name, int):
            return name
        of_plant = getattr(plant, name, None)
        return of_plant if isinstance(of_plant, int) else sizes.get(name)

    def agrees(shape: tuple[int, ...], wanted: Shape) -> bool:
        pairs = list(zip(shape, wanted, strict=False))
        return len(shape) == len(wanted) and all(size(w) in (None, n) for n, w in pairs)

    for name, given, value in _declared(part):
        found = [wanted for wanted in given["shapes"] if agrees(value.shape, wanted)]
        if not found:
            wanted = " or ".join(
                str(tuple(n if size(n) is None else size(n) for n in shape)).replace("'", "")
                for shape in given["shapes"]
            )
            raise ValueError(
                f"{type(part).__name__}.{name}: got shape {value.shape}, wanted {wanted}; a batch "
                "of problems goes through jax.vmap"
            )
        sizes.update(
            (n, m) for n, m in zip(found[0], value.shape, strict=True) if isinstance(n, str)
        )
