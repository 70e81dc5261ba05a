"""The command: what is refused before anything is measured, what is shown, saved and compared."""

import copy
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from peers import build, programs

from jaxctrl import bench, cli
from jaxctrl.bench import _layout, _peers, _plans, _run, _timing, _worker
from jaxctrl.stopwatch import Taken

SLOWED = Path(__file__).parent / "slowed"


def record(ms=1.0, **more):
    """Return what a worker says of a solve; its noise is small."""
    taken = [Taken(1e-3 * ms * f, 1e-3 * ms * f) for f in (0.99, 1.0, 1.01)]
    timing = _timing.timing([taken], [[1e3 * t.cpu for t in taken]])
    return {
        "suite": "problems", "section": "single", "mode": "fast", "dtype": "float64",
        "problem": "pendulum", "solver": "ILQR", "timing": timing, "iterations": 20, "cost": 2.0,
        "optimum": 2.0, "status": "CONVERGED_COST", "ok": True, "first_s": 0.5,
    } | more  # fmt: skip


@pytest.fixture
def call(monkeypatch, capsys):
    """Return a function that calls the command line with processes that say what they are told."""

    def call(*arguments, records=(), stop=False):
        def child(orders, take):
            for each in records:
                take(copy.deepcopy(each))
            if stop:
                raise KeyboardInterrupt

        monkeypatch.setattr(_run, "_child", child)
        monkeypatch.setattr(os, "_exit", sys.exit)
        with pytest.raises(SystemExit) as end:
            cli.main(["bench", *map(str, arguments)])
        return end.value.code, *capsys.readouterr()

    return call


def test_an_unknown_suite_is_refused_with_the_nearest_name(call):
    code, stdout, stderr = call("problem", records=[record()])
    assert code == 2 and not stdout
    assert "no suite 'problem': did you mean 'problems'?" in stderr


def test_an_unreadable_file_is_refused_before_anything_is_measured(call, tmp_path):
    path = tmp_path / "old.json"
    path.write_text("{")
    code, stdout, stderr = call("problems", "--against", path, records=[record()])
    assert code == 2 and not stdout
    assert str(path) in stderr and "not JSON" in stderr


def test_a_missing_folder_is_refused_before_anything_is_measured(call, tmp_path):
    path = tmp_path / "nowhere" / "new.json"
    code, stdout, stderr = call("problems", "--save", path, records=[record()])
    assert code == 2 and not stdout and str(path.parent) in stderr


def test_rows_appear_as_they_come_and_again_in_a_table(call):
    records = [record(), record(solver="DDP")]
    code, stdout, stderr = call("problems", "--quick", records=records)
    assert code == 0 and stderr.count("pendulum") == 2
    assert "One solve" in stdout and "CONVERGED" not in stdout


def test_what_is_saved_is_measured_in_several_processes(call, tmp_path):
    path = tmp_path / "new.json"
    _, _, stderr = call("problems", "--quick", "--save", path, records=[record()])
    assert stderr.count("pendulum") == 2
    (row,) = json.loads(path.read_text())["rows"]
    assert len(row["timing"]["relative"]) == 2


def test_a_cost_that_is_worse_says_so(call):
    records = [record(), record(solver="DDP", cost=2.1), record(solver="CG", cost=None)]
    _, stdout, _ = call("problems", "--quick", records=records)
    lines = {line.split()[1]: line for line in stdout.splitlines() if "pendulum" in line}
    assert "worse by 5 %" in lines["DDP"] and "no finite cost" in lines["CG"]
    assert "worse" not in lines["ILQR"]


def test_an_interrupted_run_keeps_what_it_has_and_the_earlier_run(call, tmp_path):
    path, partial = tmp_path / "new.json", tmp_path / "new.json.incomplete"
    call("problems", "--save", path, records=[record(), record(solver="DDP")])
    assert len(json.loads(path.read_text())["rows"]) == 2
    code, _, stderr = call("problems", "--save", path, records=[record()], stop=True)
    assert code == 130 and str(partial) in stderr
    saved = json.loads(partial.read_text())
    assert not saved["complete"] and len(saved["rows"]) == 1
    assert len(json.loads(path.read_text())["rows"]) == 2
    assert call("problems", "--save", path, stop=True)[0] == 130
    call("problems", "--save", path, records=[record()])
    assert len(json.loads(path.read_text())["rows"]) == 1 and not partial.exists()


def test_a_failed_measurement_exits_with_1(call, tmp_path):
    failure = {"suite": "problems", "section": "failure", "problem": "acrobot", "reason": "no"}
    path = tmp_path / "new.json"
    code, stdout, _ = call("problems", "--quick", "--save", path, records=[record(), failure])
    assert code == 1 and "FAILED: problems acrobot: no" in stdout
    assert json.loads(path.read_text())["failures"] == {"problems acrobot": "no"}


@pytest.mark.parametrize(
    ("ms", "word", "expected"), [(1.0, "same", 0), (1.4, "slower", 1), (0.6, "faster", 0)]
)
def test_a_run_is_compared_with_an_earlier_one(call, tmp_path, ms, word, expected):
    path = tmp_path / "old.json"
    old = [record(), record(solver="DDP"), record(problem="chain-2")]
    assert call("problems", "--quick", "--save", path, records=old)[0] == 0
    changed = json.loads(path.read_text())
    changed["machine"]["processor"] = "another"
    path.write_text(json.dumps(changed))
    new = [record(ms), record(solver="DDP"), record(problem="chain-4")]
    code, stdout, stderr = call("problems", "--quick", "--against", path, records=new)
    assert code == expected
    judged = stdout[stdout.index("Against") :]
    lines = {tuple(line.split()[1:3]): line for line in judged.splitlines() if "fast" in line}
    assert lines["pendulum", "ILQR"].endswith(word)
    assert f"{ms:.3f}" in lines["pendulum", "ILQR"]
    assert lines["pendulum", "DDP"].endswith("same")
    assert "only in the earlier run: problems single chain-2" in judged
    assert "only in the present run: problems single chain-4" in judged
    assert "different machine: processor was another" in judged
    assert ("measuring again" in stderr) == (word == "slower")


def test_other_suites_of_an_earlier_run_are_left_aside(call, tmp_path):
    path = tmp_path / "old.json"
    old = [record(), record(suite="scaling", problem="horizon 50")]
    call("problems", "scaling", "--quick", "--save", path, records=old)
    code, stdout, _ = call("problems", "--quick", "--against", path, records=[record()])
    assert code == 0 and "horizon" not in stdout


def test_what_is_missing_is_named_with_the_command_that_installs_it(call, monkeypatch, tmp_path):
    monkeypatch.setenv("CROCODDYL_PREFIX", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build, "find_eigen", missing_eigen)
    monkeypatch.setattr(programs.importlib.util, "find_spec", lambda name: None)
    built, reasons = programs.compile_peers()
    missing = {**reasons, **programs.missing_packages()}
    assert not built
    said = {"suite": "peers", "section": "missing", "missing": missing}
    code, stdout, _ = call("peers", "--quick", records=[said])
    assert code == 0
    assert "Crocoddyl (compiled, C++ models)" in stdout
    assert "pip install crocoddyl cmeel-eigen" in stdout
    assert "CasADi + IPOPT: pip install casadi" in stdout


def missing_eigen(prefixes):
    raise build.Missing("no Eigen headers (pip install cmeel-eigen)")


@pytest.fixture
def no_checkout(monkeypatch, tmp_path):
    """Make the package one that was installed from a wheel, far from the repository."""
    site = tmp_path / "site-packages" / "jaxctrl" / "bench" / "_peers.py"
    monkeypatch.setattr(_peers, "__file__", str(site))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("arguments", [["peers"], ["problems", "--peers"]])
def test_without_a_checkout_the_peers_are_refused_with_where_they_are(call, no_checkout, arguments):
    code, stdout, stderr = call(*arguments, records=[record()])
    assert code == 2 and not stdout
    assert "benchmarks/ of jaxctrl's source repository" in stderr


def test_without_a_checkout_all_other_suites_are_run(call, no_checkout, tmp_path):
    path = tmp_path / "run.json"
    code, _, stderr = call("--save", path, records=[record()])
    assert code == 0 and "left out peers: " in stderr
    assert json.loads(path.read_text())["suites"] == ["thesis", "scaling", "problems"]


def test_the_peers_of_the_working_folder_are_found(no_checkout, tmp_path):
    suite = tmp_path / "benchmarks" / "peers" / "suite.py"
    suite.parent.mkdir(parents=True)
    suite.write_text("")
    assert _peers.folder() == tmp_path / "benchmarks"


def test_every_suite_has_its_processes_and_its_module():
    for suite in bench.SUITES:
        for quick in (True, False):
            for job in _plans.jobs(suite, quick, peers=True):
                assert job.orders["suite"] == suite
                json.dumps(job.orders)
        assert callable(_worker.suite_of(suite).run)


def test_the_exponent_of_a_power_law_is_found():
    rows = [
        record(0.3 * n**1.5, suite="scaling", problem=f"horizon {n}", solver="ILQR scan")
        for n in (50, 100, 200)
    ]
    assert "1.50" in _layout.summary(rows, [], {})


def tiny(names, **changes):
    """Return the plan of one process that measures little."""
    base = {"suite": "scaling", "mode": "fast", "dtype": "float32", "quick": True, "peers": False}
    base |= _plans.QUICK | {"processes": 1, "horizons": [], "links": [], "sizes": []} | changes
    return lambda suite, quick, peers: [_plans.Job(base, base)]


def test_a_real_run_measures_and_saves(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(_plans, "jobs", tiny(["P2"], horizons=[5], sizes=[], rounds=3))
    path = tmp_path / "run.json"
    code = _run.run(
        ["scaling"], quick=True, peers=False, save=path, against=None, report=print, show=print
    )
    assert code == 0
    saved = json.loads(path.read_text())
    engines = {row["solver"] for row in saved["rows"]}
    assert (
        engines == {"ILQR sequential", "ILQR parallel"}
        and saved["complete"]
        and not saved["failures"]
    )
    for row in saved["rows"]:
        assert row["dtype"] == "float32" and row["timing"]["ms"] > 0 and row["iterations"] >= 1
        assert len(row["timing"]["relative"][0]) == 3


def test_a_process_that_dies_is_a_failure_with_its_last_words(monkeypatch, capsys):
    monkeypatch.setattr(_plans, "jobs", tiny([], suite="nonsense"))
    code = _run.run(
        ["scaling"], quick=True, peers=False, save=None, against=None, report=print, show=print
    )
    assert code == 1 and "KeyError" in capsys.readouterr().out


@pytest.mark.slow
def test_ctrl_c_ends_a_real_run_at_once(tmp_path):
    path = tmp_path / "run.json"
    line = [sys.executable, "-m", "jaxctrl", "bench", "problems", "--quick", "--save", str(path)]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()  # the first row has come
    process.send_signal(signal.SIGINT)
    start = time.monotonic()
    process.communicate(timeout=60)
    assert process.returncode == 130 and time.monotonic() - start < 10
    saved = json.loads(path.with_name("run.json.incomplete").read_text())
    assert not saved["complete"] and saved["rows"]


@pytest.mark.slow
def test_a_slowed_solver_is_found_and_an_unchanged_one_passes(tmp_path):
    """For real: steps 1.4 times as long, beside whatever else runs on this machine."""
    path, line = tmp_path / "old.json", [sys.executable, "-m", "jaxctrl", "bench", "problems"]
    line += ["--quick"]
    subprocess.run([*line, "--save", path], check=True, capture_output=True)
    same = subprocess.run([*line, "--against", path], capture_output=True, text=True)
    assert same.returncode == 0, same.stdout
    path_of = os.pathsep.join(filter(None, [str(SLOWED), os.environ.get("PYTHONPATH")]))
    slowed = subprocess.run(
        [*line, "--against", path], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": path_of},
    )  # fmt: skip
    assert slowed.returncode == 1 and "slower" in slowed.stdout
