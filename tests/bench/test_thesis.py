"""Table 4.1 comes from its experiment, whatever that finds."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray

from jaxctrl import experiments
from jaxctrl.bench import _layout, _thesis
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
    _thesis.run({"quick": True}, kept)
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
    _thesis.run({"quick": True}, kept)
    assert [row["section"] for row in kept] == ["failure"] and kept[0]["reason"] == "no"
