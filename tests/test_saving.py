"""Solutions as files and as data sets: the same numbers, and no damaged file that is trusted."""

import os
import re
import stat

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jaxctrl as jc
from jaxctrl import _files

X0 = np.array([1.0, 0.0])


def pendulum(x, u, t):
    return jnp.stack([x[1], u[0] - jnp.sin(x[0])])


def problem(**arguments):
    plant = jc.FunctionPlant(pendulum, nx=2, nu=1)
    return jc.Problem(plant, jc.QuadraticCost(Q=1.0, R=0.1), num_steps=20, dt=0.05, **arguments)


@pytest.fixture(scope="module")
def solutions():
    bounded = problem(control_bounds=(-1.0, np.inf))
    return {
        "free": jc.solve(problem(), jc.ILQR(), X0),
        "bounded": jc.solve(bounded, jc.ILQR(), X0),
        "batch": jc.solve_batch(bounded, jc.ILQR(), np.array([X0, 2 * X0, -X0])),
        "stopped": jc.solve(problem(), jc.ILQR(), 1e200 * X0),
    }


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert isinstance(other, jax.Array)
        assert one.shape == other.shape and one.dtype == other.dtype
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()  # NaN and -0 as well


@pytest.mark.parametrize("name", ["free", "bounded", "batch", "stopped"])
def test_a_solution_comes_back_bit_for_bit(tmp_path, solutions, name):
    solution = solutions[name]
    for value in (solution, solution.policy):
        jc.save(tmp_path / "it", value)
        found = jc.load(tmp_path / "it")
        assert type(found) is type(value)
        assert_same(value, found)
    assert os.listdir(tmp_path) == ["it"]  # replaced, and nothing is left beside it


def test_a_loaded_policy_runs_as_the_one_that_was_saved(tmp_path, solutions):
    bounded = problem(control_bounds=(-1.0, np.inf), noise=jc.AdditiveNoise(0.2))
    jc.save(tmp_path / "plan.npz", solutions["bounded"].policy)
    key, policy = jax.random.key(1), jc.load(str(tmp_path / "plan.npz"))
    want = jc.simulate(bounded, solutions["bounded"].policy, X0 + 0.3, key=key)
    assert_same(want, jc.simulate(bounded, policy, X0 + 0.3, key=key))
    again = jc.solve(problem(control_bounds=(-1.0, np.inf)), jc.ILQR(), X0, us=policy)
    assert again.status.ok and int(again.num_steps) == 0


def test_float32_comes_back_and_float64_is_not_rounded(tmp_path, solutions, float32):
    single = jc.solve(problem(), jc.ILQR(), X0)
    assert single.xs.dtype == jnp.float32
    jc.save(tmp_path / "single", single)
    assert_same(single, jc.load(tmp_path / "single"))
    with jax.enable_x64(True):
        jc.save(tmp_path / "double", solutions["free"])
    with pytest.raises(ValueError, match=r"double: xs is float64, which JAX would round"):
        jc.load(tmp_path / "double")


def test_files_open_without_jaxctrl(tmp_path, solutions):
    jc.save(tmp_path / "it.npz", solutions["bounded"])
    with np.load(tmp_path / "it.npz") as arrays:
        np.testing.assert_array_equal(arrays["xs"], solutions["bounded"].xs)
        np.testing.assert_array_equal(arrays["policy.K"], solutions["bounded"].policy.K)
        assert b"AffinePolicy" in bytes(arrays["layout.json"])


def refused(path, match):
    with pytest.raises(ValueError, match=match) as caught:
        jc.load(path)
    assert str(path) in str(caught.value)


def test_every_flipped_bit_and_every_cut_is_refused(tmp_path, solutions):
    path = tmp_path / "it"
    jc.save(path, solutions["free"].policy)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for at in {*rng.integers(0, len(content), 200), 0, 1, *range(len(content) - 120, len(content))}:
        flipped = bytearray(content)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        refused(path, "changed since it was written|no whole file")
    for length in (0, 1, 90, 91, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        refused(path, "no whole file of jc.save: another program's, or cut short")
    path.write_bytes(content + b"\n")
    refused(path, "no whole file")
    path.write_bytes(content)
    jc.load(path)


def test_foreign_and_newer_files_are_refused(tmp_path, solutions, monkeypatch):
    path = tmp_path / "it"
    np.savez(tmp_path / "foreign.npz", xs=np.zeros(3))
    refused(tmp_path / "foreign.npz", "no whole file of jc.save")
    path.write_text("time,x\n" * 50)
    refused(path, "no whole file of jc.save")
    with monkeypatch.context() as newer:
        newer.setattr(_files, "LAYOUT", 2)
        jc.save(path, solutions["free"])
    refused(path, "has layout 2, .* reads up to 1; a newer jaxctrl wrote it")
    with monkeypatch.context() as other:
        jc.save(path, solutions["free"])
        other.delitem(_files._CLASSES, "Status")
        refused(path, "wrote it, whose 'Status' this version, .* does not have")
    for missing in (tmp_path / "none", tmp_path):
        with pytest.raises(OSError, match=re.escape(str(missing))):
            jc.load(missing)


def test_an_interruption_leaves_what_was_there(tmp_path, solutions, monkeypatch):
    path = tmp_path / "it"
    jc.save(path, solutions["free"])
    before = path.read_bytes()
    for step in ("fsync", "replace"):
        with monkeypatch.context() as broken:

            def fail(*arguments):
                raise OSError(28, "No space left on device")

            broken.setattr(os, step, fail)
            with pytest.raises(OSError, match=rf"No space left on device: '{path}'"):
                jc.save(path, solutions["batch"])
        assert path.read_bytes() == before and os.listdir(tmp_path) == ["it"]


def test_where_and_what_cannot_be_saved_is_named(tmp_path, solutions):
    for path, error in (
        (tmp_path / "none" / "it", FileNotFoundError),
        (tmp_path, IsADirectoryError),
    ):
        with pytest.raises(error, match=re.escape(str(path))):
            jc.save(path, solutions["free"])
    assert os.listdir(tmp_path) == []
    with pytest.raises(TypeError, match="value: a solution or a policy is wanted, got a Problem"):
        jc.save(tmp_path / "it", problem())
    with pytest.raises(ValueError, match="value: a known one is wanted"):
        jax.jit(lambda s: jc.save(tmp_path / "it", s))(solutions["free"])
    jc.save(tmp_path / "it", solutions["free"])
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE((tmp_path / "it").stat().st_mode) == 0o666 & ~umask


def test_a_solution_is_a_data_set_with_names(tmp_path, solutions):
    solution = solutions["bounded"]
    data = solution.to_xarray()
    assert dict(data.sizes) == {"time": 21, "state": 2, "step": 20, "control": 1, "iterate": 501}
    np.testing.assert_array_equal(data.xs, solution.xs)
    np.testing.assert_array_equal(data.K, solution.policy.K)
    np.testing.assert_allclose(data.ts, 0.05 * np.arange(21), rtol=1e-15)
    np.testing.assert_allclose(data.step_ts, 0.05 * np.arange(20), rtol=1e-15)
    assert data.ts.attrs["units"] == "s" and data.xs.dims == ("time", "state")
    assert data.lower.dims == data.us.dims == ("step", "control") and (data.lower == -1).all()
    assert data.attrs["ok"] == 1 and data.attrs["status"] == solution.status.message
    assert str(data.reason.values) == solution.status.name
    np.testing.assert_array_equal(data.history_cost, solution.history.cost)
    data.to_netcdf(tmp_path / "it.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "it.nc", engine="h5netcdf", decode_times=False) as read:
        xarray.testing.assert_identical(read.load(), data)


def test_a_batch_is_a_data_set_with_a_lane_for_each(solutions):
    data = solutions["batch"].to_xarray()
    assert data.sizes["batch"] == 3 and data.xs.dims == ("batch", "time", "state")
    assert data.ts.dims == ("batch", "time") and data.nominal_cost.dims == ("batch",)
    one = data.isel(batch=1)
    np.testing.assert_array_equal(one.us, solutions["batch"].us[1])
    np.testing.assert_allclose(one.ts, 0.05 * np.arange(21), rtol=1e-15)
    assert "lower" not in solutions["free"].to_xarray()
    assert solutions["stopped"].to_xarray().attrs["ok"] == 0
    with pytest.raises(ValueError, match="to_xarray: known values are wanted"):
        jax.jit(lambda s: s.to_xarray())(solutions["free"])
