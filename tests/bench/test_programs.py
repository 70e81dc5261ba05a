"""The rivals solve the same problems, and their costs are those of one judge."""

import subprocess

import numpy as np
import pytest
from peers import build, programs
from peers.cases import cases
from peers.minimised import minimised


def judged(program, case):
    program.call()
    us, figures = program.found()
    return case.cost(us), figures


def test_scipy_comes_to_the_best_cost_known():
    case = cases(links=())["P2"]
    cost, figures = judged(minimised(case.problem(), case.x0, case.start), case)
    assert cost == pytest.approx(case.best, rel=1e-5) and figures["iterations"] > 5


@pytest.mark.parametrize("plugin", ["ipopt", "fatrop"])
def test_casadi_comes_to_the_best_cost_known(plugin, monkeypatch, tmp_path):
    pytest.importorskip("casadi")
    from peers import transcribed

    def none():
        raise build.Missing("no compiler")

    monkeypatch.setattr(transcribed, "find_compiler", none)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    case = cases(links=())["P2"]
    program = transcribed.transcribed("CasADi", plugin, case)
    assert "CasADi VM" in program.label
    cost, figures = judged(program, case)
    assert cost == pytest.approx(case.best, rel=1e-6) and figures["ok"]


def test_the_judge_refuses_controls_outside_their_bounds():
    case = cases(links=())["P3"]
    assert case.cost(case.start) < np.inf and case.cost(case.start - 0.2) == np.inf


@pytest.mark.slow
def test_the_compiled_peers_state_the_same_problems(tmp_path):
    """Their Jacobians agree with differences, and their cost at the start with the judge's."""
    built, reasons = build.build(tmp_path, names=("floor_peer", "selftest"))
    if reasons:
        pytest.skip(str(reasons))
    run = subprocess.run([built["selftest"]], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
    costs = {line.split()[0]: float(line.split()[-1]) for line in run.stdout.splitlines()}
    for name, case in cases().items():
        assert costs[name] == pytest.approx(case.cost(case.start), rel=1e-9)
    word, _ = programs.run_peer(built["floor_peer"], "P1", np.zeros((400, 400, 1)), 3)
    # Each pass computes alone: longer on the wall's clock than on the processor's, if anything.
    assert all(0 < cpu <= 1.01 * wall for cpu, wall in zip(word["cpu"], word["wall"], strict=True))
    program = programs.compiled(built["floor_peer"], "P2", cases()["P2"])
    assert judged(program, cases()["P2"])[0] == pytest.approx(cases()["P2"].best, rel=1e-5)
