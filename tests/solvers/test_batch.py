"""Batches of solves: lanes equal their solo runs however they are arranged."""

import os
import subprocess
import sys
import textwrap

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS

import jaxctrl as jc
from jaxctrl import _batch as batch, _cpu as cpu


@pytest.fixture(scope="module")
def pendulum():
    problem, x0 = PROBLEMS["pendulum"]()
    uss = jax.random.normal(jax.random.key(0), (5, problem.num_steps, 1))
    return problem, x0, uss, jax.vmap(lambda us: jc.solve(problem, jc.ILQR(), x0, us))(uss)


@pytest.mark.parametrize("chunk", [None, 2, 100])
def test_lanes_equal_those_of_vmap(pendulum, chunk):
    problem, x0, uss, wanted = pendulum
    got = jc.solve_batch(problem, jc.ILQR(), x0, uss, chunk=chunk)
    np.testing.assert_array_equal(got.status.code, wanted.status.code)
    np.testing.assert_allclose(got.us, wanted.us, atol=1e-9)
    np.testing.assert_allclose(got.cost, wanted.cost, rtol=1e-12)


class SmallGPU:
    """A device that says what memory it has, and is out of it with more than two lanes."""

    platform = "gpu"

    def __init__(self, lanes):
        self.lanes, self.tried = lanes, []

    def memory_stats(self):
        return {"bytes_limit": 2 * self.lanes * 10 * 100 * 3**2 * 8}

    def side_by_side(self, message):
        """Return what stands for the mapped solve: it fails as XLA does, or solves."""

        def run(job, chunk):
            self.tried.append(chunk)
            if chunk > 2:
                raise jax.errors.JaxRuntimeError(message)
            return batch._one_by_one(job)

        return run


def test_a_device_out_of_memory_takes_half_the_lanes_until_they_fit(pendulum, monkeypatch):
    problem, x0, uss, wanted = pendulum
    device = SmallGPU(lanes=5)
    monkeypatch.setattr(jax, "devices", lambda: [device])
    full = "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 7 bytes"
    monkeypatch.setattr(batch, "_side_by_side", device.side_by_side(full))
    assert problem.num_steps == 100
    with pytest.warns(UserWarning, match="out of memory; now 2 lanes at once"):
        got = jc.solve_batch(problem, jc.ILQR(), x0, uss)
    assert device.tried == [5, 2]
    np.testing.assert_allclose(got.cost, wanted.cost, rtol=1e-12)
    jc.solve_batch(problem, jc.ILQR(), x0, uss, chunk=1)
    device.lanes = 2  # so many are expected to fit
    jc.solve_batch(problem, jc.ILQR(), x0, uss)
    assert device.tried[2:] == [1, 2]
    monkeypatch.setattr(batch, "_side_by_side", device.side_by_side("INTERNAL: a bug"))
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
        jc.solve_batch(problem, jc.ILQR(), x0, uss, chunk=4)
    assert device.tried[4:] == [4]


def test_starts_and_problems_may_lead_the_batch(pendulum):
    problem, x0, uss, _ = pendulum
    x0s = x0 + 0.1 * jnp.arange(3.0)[:, None]
    by_start = jc.solve_batch(problem, jc.ILQR(), x0s)
    solo = jc.solve(problem, jc.ILQR(), x0s[2])
    np.testing.assert_allclose(by_start.us[2], solo.us, atol=1e-9)
    problems = jax.vmap(lambda dt: jc.Problem(
        problem.plant, problem.cost, num_steps=problem.num_steps, dt=dt
    ))(jnp.array([0.02, 0.021]))  # fmt: skip
    by_problem = jc.solve_batch(problems, jc.ILQR(), x0, uss[:2])
    assert by_problem.cost.shape == (2,) and by_problem.status.ok.all()


def test_best_takes_the_lowest_cost_that_converged(pendulum):
    problem, x0, uss, wanted = pendulum
    best = jc.best(wanted)
    assert best.cost.ndim == 0 and best.cost == wanted.cost.min()
    # A lower cost that did not converge does not count, NaN never does.
    worse = wanted.cost.at[0].set(-1.0).at[1].set(jnp.nan)
    spoilt = jc.solve_batch(problem, jc.ILQR(), x0, uss, max_steps=0)
    assert not jc.best(spoilt).status.ok
    codes = wanted.status.code.at[0].set(int(jc.Reason.MAX_STEPS))
    mixed = eqx.tree_at(
        lambda s: (s.nominal_cost, s.expected_cost, s.status.code), wanted, (worse, worse, codes)
    )
    assert jc.best(mixed).cost == jnp.nanmin(worse[1:])
    with pytest.raises(ValueError, match="solutions: a batch"):
        jc.best(best)
    with pytest.raises(TypeError, match=r"solutions: .*got a list"):
        jc.best([best, best])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"name: one status is wanted, got \(\d+,\)"):
        _ = mixed.status.name


def test_batches_are_differentiable_under_jit(pendulum):
    problem, x0, uss, _ = pendulum

    @jax.jit
    @jax.grad
    def slope(x0):
        return jc.solve_batch(problem, jc.DDP(), x0, uss[:2]).cost.sum()

    solo = jax.grad(lambda x0: jc.solve(problem, jc.DDP(), x0, uss[0]).cost)(x0)
    np.testing.assert_allclose(slope(x0), 2 * solo, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (lambda p, x0, uss: (x0,), r"a leading axis B > 0 .*got no such axis"),
        (lambda p, x0, uss: (jnp.stack([x0] * 3), uss), "got x0s of 3, uss of 5"),
        (lambda p, x0, uss: (x0[:1], uss), r"x0s: got shape \(1,\), wanted \(2,\)"),
        (lambda p, x0, uss: (x0, uss[:, :-1]), r"uss: got shape \(5, 99, 1\)"),
        (lambda p, x0, uss: (x0, uss[:0]), "a leading axis B > 0"),
    ],
)
def test_what_does_not_fit_is_named(pendulum, arguments, match):
    problem, x0, uss, _ = pendulum
    with pytest.raises(ValueError, match=match):
        jc.solve_batch(problem, jc.ILQR(), *arguments(problem, x0, uss))


PROGRAM = """
    import warnings
    import jaxctrl as jc
    assert jc.enable_fast_cpu(2)
    import jax
    import jax.numpy as jnp
    jax.config.update("jax_enable_x64", True)
    from problems import PROBLEMS
    problem, x0 = PROBLEMS["pendulum"]()
    assert len(jax.devices()) == 2
    uss = jax.random.normal(jax.random.key(0), (5, problem.num_steps, 1))
    shared = jc.solve_batch(problem, jc.ILQR(), x0, uss)
    print(*[float(c).hex() for c in shared.cost], *[int(c) for c in shared.status.code])
    assert jc.enable_fast_cpu(2)  # once more changes nothing
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert not jc.enable_fast_cpu(3)
    assert "too late" in str(caught[0].message), caught
"""


def test_whole_loops_on_two_devices_give_the_same_lanes(pendulum):
    wanted = pendulum[3]
    env = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(__file__))}
    env.pop("XLA_FLAGS", None)
    run = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    done = subprocess.run(run, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    words = done.stdout.split()
    np.testing.assert_allclose([float.fromhex(w) for w in words[:5]], wanted.cost, rtol=1e-12)
    np.testing.assert_array_equal([int(w) for w in words[5:]], wanted.status.code)


def test_flags_that_are_there_are_kept(monkeypatch):
    monkeypatch.setattr(cpu, "_is_live", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=/x --xla_backend_extra_options=a=1")
    assert cpu.enable_fast_cpu()
    flags = os.environ["XLA_FLAGS"].split()
    assert flags[0] == "--xla_dump_to=/x" and len(flags) == 2
    assert flags[1].startswith("--xla_backend_extra_options=a=1,xla_cpu_small_while_loop")
    with pytest.raises(ValueError, match="num_devices: at least 1"):
        cpu.enable_fast_cpu(0)
