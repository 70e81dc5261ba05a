"""What the kernels of sensed models ask of their arguments, before these are traced."""

from collections.abc import Mapping

import jax.core
import numpy as np
from jaxtyping import Array, ArrayLike

from .._types import LocalModel, Noise, Sensing, array_leaf


def shaped(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return `value` as a floating array of `shape`, where None stands for any length.

    Raises ValueError (another shape) or TypeError (no numbers), naming the argument.
    """
    array = array_leaf(value, name)
    fits = zip(array.shape, shape, strict=False)
    if array.ndim != len(shape) or any(m is not None and n != m for n, m in fits):
        wanted = str(tuple("any" if n is None else n for n in shape)).replace("'", "")
        raise ValueError(f"{name}: got shape {array.shape}, wanted {wanted}")
    return array


def checked(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return `value` as a floating array of `shape`, where None stands for any length.

    Raises ValueError (another shape; not finite, where that is known) or TypeError (no numbers),
    naming the argument.
    """
    array = shaped(name, value, shape)
    if not isinstance(array, jax.core.Tracer) and not np.isfinite(np.asarray(array)).all():
        bad = np.argwhere(~np.isfinite(np.asarray(array)))[0]
        raise ValueError(f"{name}: not finite at index {tuple(int(i) for i in bad)}")
    return array


def covariance(name: str, value: ArrayLike, size: int) -> Array:
    """Return `value` as a covariance, shape (size, size).

    Raises ValueError, naming the argument, where it is known not to be symmetric and positive
    semidefinite (up to round-off).
    """
    array = checked(name, value, (size, size))
    if isinstance(array, jax.core.Tracer):
        return array
    known = np.asarray(array, float)
    small = 1e3 * float(np.finfo(array.dtype).eps) * np.abs(known).max(initial=0.0)
    if np.abs(known - known.T).max(initial=0.0) > small:
        i, j = np.unravel_index(np.argmax(np.abs(known - known.T)), known.shape)
        raise ValueError(
            f"{name}: a symmetric matrix is wanted, got {known[i, j]} at {(int(i), int(j))} and "
            f"{known[j, i]} at {(int(j), int(i))}"
        )
    least = np.linalg.eigvalsh(known).min(initial=0.0)
    if least < -small:
        raise ValueError(
            f"{name}: a covariance has no negative eigenvalue, got {least:g}; were standard "
            "deviations or correlations meant?"
        )
    return array


def check_model(model: LocalModel) -> tuple[int, int, int]:
    """Return (T, nx, nu) of a model whose arrays fit together.

    Raises TypeError for what is no model, and ValueError naming an array of another shape.
    """
    if not isinstance(model, LocalModel):
        raise TypeError(f"model: a jc.LocalModel is wanted, got {type(model).__name__}")
    if np.ndim(model.fu) != 3:
        raise ValueError(f"model.fu: got shape {np.shape(model.fu)}, wanted (T, nx, nu)")
    T, nx, nu = np.shape(model.fu)
    shapes: Mapping[str, tuple[int, ...]] = {
        "fx": (T, nx, nx), "lx": (T, nx), "lu": (T, nu), "lxx": (T, nx, nx), "lux": (T, nu, nx),
        "luu": (T, nu, nu), "vx": (nx,), "vxx": (nx, nx),
    }  # fmt: skip
    for name, shape in shapes.items():
        shaped(f"model.{name}", getattr(model, name), shape)
    _check_noise("model.noise", model.noise, T, nx, (nx, nu))
    return T, nx, nu


def check_sensed(model: LocalModel, sensing: Sensing) -> tuple[int, int, int, int]:
    """Return (T, nx, nu, ny) of a sensed model whose arrays fit together.

    Raises TypeError for what is no model or no sensing, and as `checked` does.
    """
    T, nx, nu = check_model(model)
    for name in ("fx", "fu", "lx", "lu", "lxx", "lux", "luu", "vx", "vxx"):
        value = getattr(model, name)
        checked(f"model.{name}", value, np.shape(value))
    if not isinstance(sensing, Sensing):
        raise TypeError(f"sensing: a jc.linear.Sensing is wanted, got {type(sensing).__name__}")
    if np.ndim(sensing.F) != 3:
        raise ValueError(f"sensing.F: got shape {np.shape(sensing.F)}, wanted (T, ny, nx)")
    ny = np.shape(sensing.F)[1]
    checked("sensing.F", sensing.F, (T, ny, nx))
    if sensing.E is not None:
        checked("sensing.E", sensing.E, (T, ny, nu))
    if sensing.internal is not None:
        checked("sensing.internal", sensing.internal, (T, None, nx))
    _check_noise("sensing.noise", sensing.noise, T, ny, (nx, nu))
    for name, noise in (("model.noise", model.noise), ("sensing.noise", sensing.noise)):
        for part in ("c", "cx", "cu", "weight"):
            if noise is not None and (value := getattr(noise, part)) is not None:
                checked(f"{name}.{part}", value, np.shape(value))
    return T, nx, nu, ny


def _check_noise(name: str, noise: Noise | None, T: int, rows: int, sizes: tuple[int, int]):
    if noise is None:
        return
    if not isinstance(noise, Noise):
        raise TypeError(f"{name}: a jc.linear.Noise is wanted, got {type(noise).__name__}")
    columns = shaped(f"{name}.c", noise.c, (T, None, rows)).shape[1]
    sloping = rows
    if noise.rows is not None:
        index = noise.rows.index
        sloping = index.shape[-1]
        distinct = all(len(set(of)) == len(of) for of in noise.rows.of)
        inside = ((index >= 0) & (index < rows)).all()
        if index.shape != (columns, sloping) or not (distinct and inside):
            raise ValueError(
                f"{name}.rows: for each of {columns} columns as many of the rows 0 to {rows - 1}, "
                f"each once, are wanted, got {noise.rows.of}"
            )
    for part, size in zip(("cx", "cu"), sizes, strict=True):
        if (value := getattr(noise, part)) is not None:
            shaped(f"{name}.{part}", value, (T, columns, sloping, size))
    if noise.weight is not None:
        shaped(f"{name}.weight", noise.weight, (T, rows, rows))
