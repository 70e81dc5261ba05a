"""The folder of one finished experiment: written whole or not at all, and verified when read.

`<out>/<name>/` holds config.json, result.nc, figure.pdf, figure.png, claims.json and done.json, the
manifest with the SHA-256 of the others. The files are written into a temporary sibling, forced to
the disk and renamed into place, so that an interruption at any moment leaves the finished
experiments whole; what a killed run left behind is removed by the next.

A result that could not be drawn or judged is kept in the same way, in `<out>/<name>.unfinished/`:
config.json, result.nc and done.json, whose failure is what was raised.
"""

import contextlib
import hashlib
import importlib.metadata
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import filelock
import xarray

from jaxctrl import __version__

from ._result import Claim, Result

SCHEMA = 1
"""Number of the layout described above; a folder of another number is refused."""

MANIFEST = "done.json"
"""Name of the manifest, the last file to be written."""

_FILES = ("config.json", "result.nc", "figure.pdf", "figure.png", "claims.json")
_ATTRIBUTES = ("experiment", "config", "jaxctrl", "schema", "failure")
_UNFINISHED = ".unfinished"
_PARTIAL = ".jaxctrl-partial-"
_REPLACED = ".replaced"
_PROBE = 1 << 20


class StoreError(Exception):
    """Report a folder or file that cannot be written or be trusted: its path and the reason."""


@dataclass(frozen=True)
class Manifest:
    """Hold what done.json says of an experiment.

    Arguments:
        schema: number of the folder's layout.
        experiment: name in the registry.
        versions: of jaxctrl, jax and numpy, and the fingerprint of a user's own file.
        wall_seconds: how long the experiment took [s].
        failure: reason why the result cannot be trusted or is unfinished, or empty.
        files: size in bytes and SHA-256 of each file.
    """

    schema: int
    experiment: str
    versions: dict[str, str]
    wall_seconds: float
    failure: str
    files: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Finished:
    """Hold a finished experiment whose files have been verified.

    Arguments:
        folder: where the files are.
        manifest: what done.json says.
        config: the settings, as `settings` gives them.
        claims: what is claimed and what was measured.
    """

    folder: Path
    manifest: Manifest
    config: dict[str, Any]
    claims: tuple[Claim, ...]

    def data(self) -> xarray.Dataset:
        """Load the arrays from result.nc."""
        return xarray.load_dataset(self.folder / "result.nc", engine="h5netcdf", decode_times=False)

    def result(self, config: Any) -> Result:
        """Return the result as it was before it was written, with the `Config` that gave it."""
        data = self.data()
        failure = data.attrs["failure"]
        data.attrs = {key: value for key, value in data.attrs.items() if key not in _ATTRIBUTES}
        return Result(data, config, failure)


def settings(config: Any) -> dict[str, Any]:
    """Return a Config as JSON can hold it: NaN and infinities become "nan", "inf", "-inf".

    Raises: TypeError naming a field that is neither int, float, bool nor str.
    """
    values = asdict(config)
    for key, value in values.items():
        if not isinstance(value, int | float | str):
            raise TypeError(f"Config.{key} must be int, float, bool or str, got {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            values[key] = str(value)
    return values


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """Create a results folder, hold it for this run alone, and remove what killed runs left.

    Raises: StoreError, before anything is computed, when the folder cannot be created or written,
    its disk is full, or another run holds it.
    """
    with contextlib.ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            stack.enter_context(filelock.FileLock(out / ".jaxctrl.lock", timeout=0))
            _clean(out)
            with tempfile.TemporaryFile(dir=out) as probe:
                probe.write(bytes(_PROBE))
                probe.flush()
                os.fsync(probe.fileno())
        except filelock.Timeout as error:
            raise StoreError(
                f"{out}: another run is writing into this folder; wait for it or choose another"
            ) from error
        except OSError as error:
            raise StoreError(f"{out}: cannot write into this folder ({error.strerror})") from error
        yield


def locate(out: Path, name: str) -> Path:
    """Return the folder of an experiment, which need not exist.

    Raises: StoreError when something else is in its place.
    """
    folder = out / name
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise StoreError(f"{folder}: is not a folder of its own; move it away")
    return folder


def check_ours(folder: Path) -> None:
    """Raise a StoreError when a folder that is to be replaced holds a file that is not ours."""
    if folder.exists():
        foreign = sorted({path.name for path in folder.iterdir()} - {*_FILES, MANIFEST})
        if foreign:
            raise StoreError(f"{folder / foreign[0]}: not a file of jaxctrl; move it away")


def write(
    out: Path,
    name: str,
    result: Result,
    figure: Any,
    claims: list[Claim],
    seconds: float,
    own: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Write a finished experiment, all of it or nothing, and return its folder.

    A finished experiment of that name is replaced. The caller holds `locked(out)`.

    Arguments:
        figure: matplotlib Figure, saved as PDF and PNG.
        seconds: how long the experiment took [s].
        own: name and fingerprint of the experiment's file, where it is not one of the package.
    """

    def draw(folder: Path):
        _write_json(folder / "claims.json", [asdict(claim) for claim in claims])
        figure.savefig(folder / "figure.pdf", metadata={"CreationDate": None})
        figure.savefig(folder / "figure.png")

    written = _write(out, name, name, result, draw, result.failure, seconds, own)
    kept = out / f"{name}{_UNFINISHED}"
    if kept.exists():  # renamed first, so that it is never there in part
        check_ours(kept)
        shutil.rmtree(kept.rename(out / f"{_PARTIAL}{kept.name}"))
    return written


def keep(
    out: Path, name: str, result: Result, failure: str, seconds: float, own: Mapping[str, str]
) -> Path:
    """Write a result that could not be drawn or judged, with the reason, and return its folder.

    A finished experiment of that name stays as it is. The caller holds `locked(out)`.
    """
    folder = f"{name}{_UNFINISHED}"
    return _write(out, folder, name, result, lambda partial: None, failure, seconds, own)


def unfinished(out: Path, name: str) -> Finished | None:
    """Read and verify the result that was kept when drawing or judging it failed, if there is one.

    Raises: StoreError as `read` does.
    """
    folder = locate(out, f"{name}{_UNFINISHED}")
    return _read(folder, name) if folder.exists() else None


def _write(
    out: Path,
    place: str,
    name: str,
    result: Result,
    draw: Callable[[Path], None],
    failure: str,
    seconds: float,
    own: Mapping[str, str],
) -> Path:
    """Write the folder `place` of an experiment: data, what `draw` adds, manifest."""
    partial = out / f"{_PARTIAL}{place}"
    partial.mkdir()
    try:
        _write_result(partial, name, result)
        draw(partial)
        manifest = Manifest(
            schema=SCHEMA,
            experiment=name,
            versions={
                "jaxctrl": __version__,
                **{package: importlib.metadata.version(package) for package in ("jax", "numpy")},
                **own,
            },
            wall_seconds=round(seconds, 3),
            failure=failure,
            files={
                file: _fingerprint((partial / file).read_bytes())
                for file in _FILES
                if (partial / file).exists()
            },
        )
        record = asdict(manifest)
        _write_json(partial / MANIFEST, {**record, "sha256": _digest(record)})
        for path in (*partial.iterdir(), partial):
            _sync_path(path)
        return _publish(partial, locate(out, place))
    except BaseException:
        _clean(out)
        raise


def read(out: Path, name: str) -> Finished:
    """Read a finished experiment and verify every byte of its files.

    Raises: StoreError naming the file and what is wrong: missing, truncated, changed since it was
    written, of another experiment, or of another layout.
    """
    return _read(locate(out, name), name)


def _read(folder: Path, name: str) -> Finished:
    manifest = _read_manifest(folder, name)
    content: dict[str, bytes] = {}
    for file, expected in manifest.files.items():
        content[file] = _read_bytes(folder / file)
        found = _fingerprint(content[file])
        if found["bytes"] != expected["bytes"]:
            raise StoreError(
                f"{folder / file}: has {found['bytes']} bytes, was written with {expected['bytes']}"
            )
        if found != expected:
            raise StoreError(f"{folder / file}: changed since it was written (SHA-256 differs)")
    config = json.loads(content["config.json"])
    claims = tuple(Claim(**claim) for claim in json.loads(content.get("claims.json", "[]")))
    return Finished(folder, manifest, config, claims)


def _write_result(folder: Path, name: str, result: Result) -> None:
    """Write settings and data."""
    config = settings(result.config)
    _write_json(folder / "config.json", config)
    data = result.data.assign_attrs(
        experiment=name,
        config=json.dumps(config, allow_nan=False),
        jaxctrl=__version__,
        schema=SCHEMA,
        failure=result.failure,
    )
    # through memory, because HDF5 ends the process with a segmentation fault on a full disk
    (folder / "result.nc").write_bytes(data.to_netcdf(engine="h5netcdf"))


def _publish(partial: Path, folder: Path) -> Path:
    """Rename a complete folder into its place and force the renaming to the disk."""
    check_ours(folder)
    if folder.exists():
        replaced = partial.with_name(partial.name + _REPLACED)
        folder.rename(replaced)
        partial.rename(folder)
        shutil.rmtree(replaced)
    else:
        partial.rename(folder)
    _sync_path(folder.parent)
    return folder


def _clean(out: Path) -> None:
    """Remove what was left unfinished, and put back what was not replaced after all."""
    for leftover in out.glob(f"{_PARTIAL}*"):
        folder = out / leftover.name.removeprefix(_PARTIAL).removesuffix(_REPLACED)
        if leftover.name.endswith(_REPLACED) and not folder.exists():
            leftover.rename(folder)
        else:
            shutil.rmtree(leftover)


def _read_manifest(folder: Path, name: str) -> Manifest:
    """Read done.json and verify that it is whole, of this layout and of this experiment."""
    path = folder / MANIFEST
    try:
        record = json.loads(_read_bytes(path))
        schema, digest = record["schema"], record.pop("sha256")
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise StoreError(f"{path}: damaged, or not a manifest of jaxctrl") from error
    if schema != SCHEMA:
        raise StoreError(f"{path}: has layout {schema!r}, this version reads layout {SCHEMA}")
    if digest != _digest(record):
        raise StoreError(f"{path}: changed since it was written (SHA-256 differs)")
    manifest = Manifest(**record)
    if manifest.experiment != name:
        raise StoreError(f"{path}: belongs to the experiment {manifest.experiment!r}")
    return manifest


def _read_bytes(path: Path) -> bytes:
    """Return the bytes of a file, or raise a StoreError that names it."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise StoreError(f"{path}: missing, so this is no finished experiment") from error
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error.strerror})") from error


def _fingerprint(content: bytes) -> dict[str, Any]:
    """Return size and SHA-256 of a file's content."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _digest(record: dict[str, Any]) -> str:
    """Return the SHA-256 of a manifest's values."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, which has no NaN."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _sync_path(path: Path) -> None:
    """Force a file or the entries of a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
