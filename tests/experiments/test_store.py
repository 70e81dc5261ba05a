"""A finished experiment is whole or absent, and whatever else lies in its place is refused."""

import errno
import json
import os
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import fake_experiments as fake
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

from jaxctrl.experiments import _store
from jaxctrl.experiments._result import Claim, Result

FILES = ("config.json", "result.nc", "figure.pdf", "figure.png", "claims.json", "done.json")


def write(out, name="good", config=None):
    result = fake.result(config or fake.Config())
    with _store.locked(out):
        return _store.write(out, name, result, fake.figure(result), fake.claims(result), 1.5)


@pytest.fixture
def out(tmp_path):
    write(tmp_path)
    return tmp_path


def refuse_constant(token):
    raise AssertionError(f"bare {token} in JSON")


def test_a_written_experiment_reads_back_identical(out):
    found = _store.read(out, "good")
    written = fake.result(fake.Config())
    assert xarray.testing.assert_equal(found.data(), written.data) is None
    for name, variable in written.data.variables.items():
        assert {key: found.data()[name].attrs[key] for key in variable.attrs} == variable.attrs
    assert found.config == {"seed": 0, "gain": 0.5, "label": "reach", "noisy": True}
    assert list(found.claims) == fake.claims(written)
    assert found.manifest.wall_seconds == 1.5
    assert set(found.manifest.versions) == {"jaxctrl", "jax", "numpy"}


def test_the_folder_holds_the_documented_files_and_nothing_else_remains(out):
    assert sorted(path.name for path in (out / "good").iterdir()) == sorted(FILES)
    assert {path.name for path in out.iterdir()} <= {"good", ".jaxctrl.lock"}


def test_the_data_file_alone_tells_where_it_comes_from(out):
    data = xarray.load_dataset(out / "good" / "result.nc", engine="h5netcdf")
    assert json.loads(data.attrs["config"])["gain"] == 0.5
    assert data.attrs["experiment"] == "good"
    assert data.attrs["schema"] == _store.SCHEMA
    assert data.attrs["jaxctrl"] == _store.__version__


def test_equal_results_give_equal_bytes(tmp_path):
    first, second = write(tmp_path / "a"), write(tmp_path / "b")
    for file in FILES:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_json_has_no_bare_nan_or_infinity(tmp_path):
    write(tmp_path, config=fake.Config(gain=float("inf")))
    write(tmp_path, "last", config=fake.Config(gain=float("nan")))
    for path in tmp_path.rglob("*.json"):
        json.loads(path.read_text("utf-8"), parse_constant=refuse_constant)
    assert _store.read(tmp_path, "good").config["gain"] == "inf"
    assert _store.read(tmp_path, "last").config["gain"] == "nan"
    json.loads(_store.read(tmp_path, "last").data().attrs["config"], parse_constant=refuse_constant)


@pytest.mark.parametrize("file", FILES)
def test_a_missing_file_is_refused_by_name(out, file):
    (out / "good" / file).unlink()
    with pytest.raises(_store.StoreError, match=f"{file}: missing"):
        _store.read(out, "good")


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("size", [0, -1])
def test_a_truncated_file_is_refused_by_name(out, file, size):
    path = out / "good" / file
    path.write_bytes(path.read_bytes()[:size])
    if (file, size) == ("done.json", -1):  # the line end after the last brace
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(_store.StoreError, match=f"{file}: (has|damaged)"):
        _store.read(out, "good")


@pytest.mark.parametrize("file", FILES)
def test_a_flipped_bit_anywhere_is_refused_by_name(out, file):
    path = out / "good" / file
    content = path.read_bytes()
    for position in range(0, len(content) - 1, max(1, len(content) // 200)):
        flipped = bytearray(content)
        flipped[position] ^= 1 << position % 8
        path.write_bytes(flipped)
        with pytest.raises(_store.StoreError, match=file):
            _store.read(out, "good")


def test_a_folder_of_another_experiment_is_refused(out):
    shutil.copytree(out / "good", out / "last")
    with pytest.raises(_store.StoreError, match=r"done.json: belongs to the experiment 'good'"):
        _store.read(out, "last")


def test_a_data_file_of_another_experiment_is_refused(out):
    other = write(out, "last", fake.Config(seed=7))
    shutil.copy(other / "result.nc", out / "good" / "result.nc")
    with pytest.raises(_store.StoreError, match=r"result.nc: changed"):
        _store.read(out, "good")


def test_an_older_layout_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as older:
        older.setattr(_store, "SCHEMA", 0)
        write(tmp_path)
    with pytest.raises(_store.StoreError, match=r"has layout 0, this version reads layout 1"):
        _store.read(tmp_path, "good")


@pytest.mark.parametrize("text", ["", "[]", "3", "null", "{}", '{"schema": 1}', '"\ud800"', "\xff"])
def test_a_manifest_of_somebody_else_is_refused(out, text):
    (out / "good" / "done.json").write_bytes(text.encode("latin-1", "replace"))
    with pytest.raises(_store.StoreError, match=r"done.json: damaged"):
        _store.read(out, "good")


def test_a_file_or_link_where_the_folder_should_be_is_refused(out):
    (out / "last").write_text("mine")
    (out / "waits").symlink_to(out / "good")
    for name in ("last", "waits"):
        with pytest.raises(_store.StoreError, match="not a folder of its own"):
            _store.read(out, name)
        with pytest.raises(_store.StoreError, match="not a folder of its own"):
            write(out, name)
    assert (out / "last").read_text() == "mine"


def test_a_folder_with_foreign_files_is_never_replaced(out):
    (out / "good" / "notes.txt").write_text("mine")
    _store.read(out, "good")
    with pytest.raises(_store.StoreError, match=r"notes.txt: not a file of jaxctrl"):
        write(out)
    assert (out / "good" / "notes.txt").read_text() == "mine"
    assert not list(out.glob(f"{_store._PARTIAL}*"))


def interrupt_at(monkeypatch, step, error):
    """Raise an error at one call of fsync or rename."""
    calls = iter(range(10**6))

    def patched(function):
        def call(*arguments):
            if next(calls) == step:
                raise error
            return function(*arguments)

        return call

    monkeypatch.setattr(os, "fsync", patched(os.fsync))
    monkeypatch.setattr(Path, "rename", patched(Path.rename))


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "disk full")])
def test_an_interruption_at_any_step_leaves_the_old_the_new_or_none(
    tmp_path, monkeypatch, exists, error
):
    seen = set()
    for step in range(1, 30):
        out = tmp_path / str(step)
        if exists:
            write(out)
        with monkeypatch.context() as patch:
            interrupt_at(patch, step, error)
            try:
                write(out, config=fake.Config(seed=1))
                complete = True
            except type(error):
                complete = False
        with _store.locked(out):
            pass
        left = [path.name for path in out.iterdir() if path.name != ".jaxctrl.lock"]
        assert left in ([], ["good"])
        seen.add(_store.read(out, "good").config["seed"] if left else None)
        if complete:
            break
    assert complete
    assert seen == ({0, 1} if exists else {None, 1})


def test_a_failing_figure_leaves_the_finished_experiment_alone(out):
    result = fake.result(fake.Config(seed=1))
    with _store.locked(out), pytest.raises(AttributeError):
        _store.write(out, "good", result, None, [], 1.0)
    assert _store.read(out, "good").config["seed"] == 0


def test_left_overs_of_a_killed_run_are_removed_by_the_next(out):
    left = out / f"{_store._PARTIAL}last"
    left.mkdir()
    (left / "result.nc").write_bytes(b"half")
    with _store.locked(out):
        assert not left.exists()
    _store.read(out, "good")


def test_two_runs_cannot_hold_one_folder(tmp_path):
    with _store.locked(tmp_path):
        with (
            pytest.raises(_store.StoreError, match="another run is writing"),
            _store.locked(tmp_path),
        ):
            pass
        assert (tmp_path / ".jaxctrl.lock").exists()
    with _store.locked(tmp_path):
        pass


@pytest.mark.parametrize("place", ["file", "file/below", "/proc/jaxctrl", "/dev/null"])
def test_an_unusable_folder_is_refused_with_its_name(tmp_path, place):
    if place.startswith("/proc") and not sys.platform.startswith("linux"):
        pytest.skip("no /proc here")
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(_store.StoreError, match=f"{place}: cannot write into this folder"),
        _store.locked(tmp_path / place),
    ):
        pass


def test_a_full_disk_is_noticed_before_computing(tmp_path, monkeypatch):
    interrupt_at(monkeypatch, 0, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with pytest.raises(_store.StoreError, match="No space left"), _store.locked(tmp_path):
        pass
    with _store.locked(tmp_path):
        pass


def test_spaces_and_unicode_in_the_path_work(tmp_path):
    out = tmp_path / "my results" / "übung θ 実験"
    write(out)
    assert _store.read(out, "good").data().sizes == {"time": 5, "axis": 2}


def test_a_setting_that_is_no_scalar_is_refused_by_name():
    @dataclass(frozen=True)
    class Config:
        starts: tuple = (1, 2)

    with pytest.raises(TypeError, match=r"Config.starts must be int, float, bool or str"):
        _store.settings(Config())


@pytest.mark.parametrize("attribute", ["units", "long_name"])
def test_a_result_without_names_or_units_is_refused_by_variable(attribute):
    data = fake.result(fake.Config()).data.copy()
    del data["hand"].attrs[attribute]
    with pytest.raises(ValueError, match=f"'hand' of the result has no '{attribute}'"):
        Result(data, fake.Config())


def test_device_arrays_of_a_result_become_numpy_arrays():
    attributes = {"units": "rad", "long_name": "joint angles"}
    data = xarray.Dataset({"angle": ("time", jnp.arange(3.0), attributes)})
    assert isinstance(Result(data, fake.Config()).data["angle"].variable._data, np.ndarray)


def test_a_claim_judged_by_an_array_is_a_bool():
    claim = Claim("it is so", "fig. 1", "1", "1", jnp.array(1.0) > 0)
    assert claim.holds is True
    assert replace(claim, holds=np.bool_(False)).holds is False
