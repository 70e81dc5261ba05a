"""Table 4.1 comes from its experiment, whatever that finds; what is timed under noise has bars."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jaxctrl as jc
from jaxctrl import experiments
from jaxctrl.bench import _bars, _layout, _plans, _thesis, _under_noise
from jaxctrl.experiments._result import Claim


@pytest.fixture
def table(monkeypatch):
    """Install an experiment with one problem and two methods, one of which never gets there."""
    near, nan = np.array([1e-2, 1e-4]), np.nan
    seconds = [[[0.1, 0.2], [nan, nan]]]
    dims = ("problem", "solver", "near")
    data = xarray.Dataset(
        {
            "seconds": (dims, seconds),
            "spread": (dims, 0.1 * np.array(seconds)),
            "wall": (dims, 1.5 * np.array(seconds)),
            "iterations": (dims, [[[3.0, 5.0], [nan, nan]]]),
            "cost": (dims[:2], [[2.0, nan]]),
            "first": (dims[:2], [[1.0, 1.5]]),
            "status": (dims[:2], [["CONVERGED_COST", "STALLED"]]),
            "best": ("problem", [2.0]),
        },
        {"problem": ["torque"], "solver": ["ILQR", "BVP"], "near": near},
    )
    claim = Claim("ILQR is fastest", "table 4.1", "2x", "0.5x", False, "It is not.")
    module = SimpleNamespace(
        Config=SimpleNamespace(quick=lambda: None),
        run=lambda config: SimpleNamespace(data=data, failure=""),
        claims=lambda result: [claim],
        table=lambda result: [("problem", "ILQR"), ("torque", "0.2 s")],
    )
    monkeypatch.setattr(experiments, "load", lambda name: module)
    return module


class Kept(list):
    """Keep what a worker hands over."""

    def __call__(self, section, **figures):
        common = {"suite": "thesis", "mode": "fast", "dtype": "float64", "section": section}
        self.append(common | figures)

    def failure(self, what, error):
        self("failure", problem=what, reason=str(error))


def test_the_table_and_its_claims_are_shown(table):
    kept = Kept()
    _thesis.run({"quick": True, "part": "table"}, kept)
    shown = _layout.summary(kept, [], {})
    assert "Table 4.1" in shown and "torque   0.2 s" in shown
    assert (
        "NO   ILQR is fastest\n     expected: 2x\n     measured: 0.5x\n     note: It is not."
        in shown
    )
    ilqr = next(row for row in kept if row.get("solver") == "ILQR")
    assert ilqr["timing"]["cpu_ms"] == 200 and ilqr["timing"]["ms"] == pytest.approx(300)
    assert ilqr["iterations"] == 5
    assert ilqr["note"] == "within 0.0001 of the best cost"


def test_an_experiment_that_fails_is_a_failed_measurement(table):
    def fail(config):
        raise RuntimeError("no")

    table.run = fail
    kept = Kept()
    _thesis.run({"quick": True, "part": "table"}, kept)
    assert [row["section"] for row in kept] == ["failure"] and kept[0]["reason"] == "no"


@pytest.fixture
def small(monkeypatch):
    """Let a point on a line reach under noise, in place of the arm: it compiles in a moment."""

    def reaches(noise):
        def reach(goal):
            plant = jc.FunctionPlant(lambda x, u, t: u - x**3, nx=1, nu=1)
            cost = jc.QuadraticCost(R=0.1, Qf=1.0, target=goal)
            many = None if noise is None else jc.SignalDependentNoise(noise)
            return jc.Problem(plant, cost, num_steps=5, dt=0.1, noise=many)

        return jax.vmap(reach)(jnp.linspace(-1.0, 1.0, 16)[:, None]), jnp.ones(1)

    monkeypatch.setattr(_under_noise, "reaches", reaches)


@pytest.mark.slow  # seven programs are compiled
def test_what_is_timed_under_noise_is_held_to_its_bars(small):
    kept = Kept()
    orders = next(job.orders for job in _plans.jobs("thesis", True, False)[1:])
    _thesis.run({**orders, "rounds": 3}, kept)
    assert [row["section"] for row in kept] == ["noise"] * 7
    assert all(row["ok"] for row in kept if "ok" in row)
    cut = {row["solver"]: row["iterations"] for row in kept if row["problem"] == _bars.CUT}
    assert cut == {"ILQR": 1, "ILQG": 1}
    held = list(_bars.of_noise(kept))
    assert all(bar["figure"] > 0 for bar in held[1:])
    shown = _layout.summary(kept, held, {})
    assert "1000 trials" in shown and "one iteration, ILQG / ILQR" in shown


def test_bars_under_noise_are_differences_and_ratios_of_processor_times():
    def row(problem, solver, cpu_ms, **more):
        names = {"section": "noise", "problem": problem, "solver": solver}
        return names | {"timing": {"cpu_ms": cpu_ms, "ms": 1e3}} | more

    rows = [
        row(_bars.REACH, "ILQR", 5.0, iterations=5), row(_bars.CUT, "ILQR", 1.0),
        row(_bars.REACH, "ILQG", 14.0, iterations=7), row(_bars.CUT, "ILQG", 2.0),
        row(_bars.TRIALS, "evaluate", 61.0),
        row(_bars.BATCH, "ILQG", 30.0), row(_bars.LOOP, "ILQG", 32.0),
    ]  # fmt: skip
    held = list(_bars.of_noise(rows))
    assert [bar["figure"] for bar in held] == [2.0, 61.0, 15.0]
    assert [bar["verdict"] for bar in held] == ["met", "MISSED", "met"]
    missing = list(_bars.of_noise(rows[1:5]))
    assert [bar["verdict"] for bar in missing] == ["not measured", "MISSED", "not measured"]
