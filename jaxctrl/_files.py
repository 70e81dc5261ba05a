"""Save a solution or a policy in one file, whole or not at all, and read it back bit for bit.

The file is a NumPy archive (`np.load` opens it) of the arrays and of `layout.json`, which says what
they are. The archive's comment, the end of the file, holds the number of the layout and the SHA-256
of all that comes before.
"""

import hashlib
import io
import json
import os
import re
import secrets
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._checks import is_concrete
from ._controller import AffinePolicy
from ._estimator import LinearFilter, OutputFeedback
from ._prediction import Prediction
from ._solution import Solution
from ._solver import Record
from ._status import Status
from ._version import __version__

LAYOUT = 1
"""Number of the layout described above; a file of a higher number is refused."""

_CLASSES = {
    cls.__name__: cls
    for cls in (
        Solution, Prediction, AffinePolicy, OutputFeedback, LinearFilter, Status, Record,
    )
}  # fmt: skip
_COMMENT = re.compile(rb"jaxctrl layout (\d{4}) sha256 ([0-9a-f]{64})")
_LENGTH = len("jaxctrl layout 0001 sha256 ") + 64


def save(path: str | os.PathLike, value: Solution | AffinePolicy | OutputFeedback) -> None:
    """Save a solution, a policy, or a batch of them in one file.

    The file is written beside `path`, forced to the disk and renamed, so that an interruption
    leaves what was there before. Nothing in it is code.

    Arguments:
        path: the file, replaced if there is one; its folder has to exist.
        value: `solution` or `solution.policy`, as `solve` or `solve_batch` returns them.

    Raises TypeError for another value, ValueError for a traced one, OSError naming the path where
    it cannot be written.
    """
    if not isinstance(value, Solution | AffinePolicy | OutputFeedback):
        raise TypeError(f"value: a solution or a policy is wanted, got a {type(value).__name__}")
    if not is_concrete(*jax.tree.leaves(eqx.filter(value, eqx.is_array))):
        raise ValueError(
            "value: a known one is wanted, got one that is traced; save outside of jit"
        )
    arrays: dict[str, np.ndarray] = {}
    layout = {"version": __version__, "value": _pack(value, "", arrays)}
    path = Path(path)
    partial = path.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        with open(partial, "xb") as file:
            file.write(_bytes(layout, arrays))
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def load(path: str | os.PathLike) -> Any:
    """Read the solution or policy that `save` wrote, every number and dtype as it was.

    Raises ValueError naming the path for a file that is foreign, cut short, changed since it was
    written, or of a newer version, and for float64 where JAX's x64 is off; OSError where it cannot
    be read.
    """
    content = Path(path).read_bytes()
    found = _COMMENT.fullmatch(content[-_LENGTH:])
    if found is None or not content.startswith(b"PK"):
        raise ValueError(f"{path}: no whole file of jc.save: another program's, or cut short")
    if hashlib.sha256(content[:-64]).hexdigest().encode() != found[2]:
        raise ValueError(f"{path}: changed since it was written (its SHA-256 differs)")
    if int(found[1]) > LAYOUT:
        raise ValueError(
            f"{path}: has layout {int(found[1])}, this version, {__version__}, reads up to "
            f"{LAYOUT}; a newer jaxctrl wrote it"
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        layout = json.loads(bytes(arrays["layout.json"]))
        try:
            return _unpack(layout["value"], arrays, str(path))
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"{path}: jaxctrl {layout['version']} wrote it, whose {error} this version, "
                f"{__version__}, does not have"
            ) from error


def _pack(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """Collect a value's arrays by name, and return what JSON can hold of it: where they belong."""
    if value is None:
        return None
    if isinstance(value, tuple) and not isinstance(value, Record):
        return [_pack(part, f"{name}[{i}]", arrays) for i, part in enumerate(value)]
    if type(value) in _CLASSES.values():
        names = [*getattr(value, "_fields", ()), *getattr(value, "__dataclass_fields__", ())]
        packed = {key: _pack(getattr(value, key), f"{name}.{key}", arrays) for key in names}
        return {"class": type(value).__name__, "fields": packed}
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"value{name}: numbers that NumPy knows are wanted, got {value!r}")
    arrays[name[1:]] = array
    return name[1:]


def _unpack(packed: Any, arrays: Any, path: str) -> Any:
    """Return the value of which `_pack` made this."""
    if packed is None:
        return None
    if isinstance(packed, list):
        return tuple(_unpack(part, arrays, path) for part in packed)
    if isinstance(packed, dict):
        fields = {key: _unpack(part, arrays, path) for key, part in packed["fields"].items()}
        return _CLASSES[packed["class"]](**fields)
    array = arrays[packed]
    if jax.dtypes.canonicalize_dtype(array.dtype) != array.dtype:
        raise ValueError(
            f"{path}: {packed} is {array.dtype}, which JAX would round; switch x64 on first, "
            'jax.config.update("jax_enable_x64", True)'
        )
    return jnp.asarray(array)


def _bytes(layout: dict, arrays: dict[str, np.ndarray]) -> bytes:
    """Return the content of a file: an archive, whose comment is about the rest of it."""
    text = np.frombuffer(json.dumps(layout).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **{"layout.json": text}, **arrays)  # pyright: ignore[reportArgumentType]
    # An archive's last two bytes are the length of its comment, until now 0.
    content = buffer.getvalue()[:-2] + _LENGTH.to_bytes(2, "little")
    content += f"jaxctrl layout {LAYOUT:04d} sha256 ".encode()
    return content + hashlib.sha256(content).hexdigest().encode()


def _sync(folder: Path) -> None:
    """Force the entries of a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
