"""A user's own file runs like the published experiments, and what is wrong with one is said."""

import json
import re
import sys
from pathlib import Path

import fake_experiments as fake
import pytest

import jaxctrl as jc
from jaxctrl import cli, experiments
from jaxctrl.experiments import _store

DOCS = Path(__file__).parents[2] / "docs" / "experiments.md"
GOOD = """
'''What mine does.

And more.
'''
from fake_experiments import Config, claims, figure, result as run
"""


@pytest.fixture
def call(monkeypatch, capsys, tmp_path):
    """Return a function that calls the command line in an empty folder, with fake experiments."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(experiments, "EXPERIMENTS", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = {}
    fake.install(("good", "last"), experiments.EXPERIMENTS, modules)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)

    def call(*arguments):
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in arguments])
        return end.value.code, *capsys.readouterr()

    return call


def test_the_experiment_of_the_documentation_runs(call):
    (program,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    Path("haste.py").write_text(program)
    code, stdout, _ = call("run", "haste.py", "--quick", "--set", "longest=0.8")
    assert code == 0 and re.search(r"yes  Haste costs\n +expected: falls\n", stdout), stdout
    found = _store.read(Path("results"), "haste")
    assert found.config == {"longest": 0.8, "num_steps": 25}
    assert found.data().duration.values.tolist() == [0.2, 0.4, 0.8]
    code, stdout, _ = call("show", "haste.py")
    assert code == 0 and "haste: Swing a pendulum up in ever more time" in stdout
    assert "duration  duration 3  s      duration" in stdout


def test_a_file_runs_beside_the_registry_and_is_finished_like_it(call):
    Path("mine.py").write_text(GOOD)
    for state in ("finished", "skipped"):
        code, stdout, stderr = call("run", "mine.py", "all", "--set", "seed=4")
        assert code == 0 and stderr.count(f" {state} ") == 3, stderr
        assert "\nmine: 1 of 2 claims hold\nyes  the path is straight" in stdout
    code, stdout, _ = call("show", "mine.py")
    assert code == 0 and "mine: What mine does." in stdout and "seed   4" in stdout


def test_a_file_that_has_changed_is_not_taken_for_finished(call):
    Path("mine.py").write_text(GOOD)
    assert call("run", "mine.py")[0] == 0
    Path("mine.py").write_text(GOOD + "\n# changed\n")
    code, stdout, _ = call("run", "mine.py")
    assert code == 1 and "mine.py has changed since; --force" in stdout
    assert call("run", "mine.py", "--force")[0] == 0
    assert call("run", "mine.py")[0] == 0
    Path("mine.py").unlink()  # what was found is still shown
    Path("mine.py").write_text("1 +")
    code, stdout, _ = call("show", "mine.py")
    assert code == 0 and stdout.startswith("mine: \nmade by jaxctrl ")


def test_a_mended_figure_takes_the_data_of_the_run_before(call):
    counted = "\ndef run(config):\n    print('computing')\n    return result(config)\n"
    good = GOOD.replace("result as run", "result") + counted
    Path("mine.py").write_text(good + "def figure(result): return result.data.hnad\n")
    code, stdout, _ = call("run", "mine.py")
    assert (
        code == 1 and "computing" in stdout and "data are kept in results/mine.unfinished" in stdout
    )
    code, stdout, _ = call("show", "mine.py")
    assert code == 1 and "The last run FAILED: AttributeError" in stdout
    assert "results/mine.unfinished/result.nc" in stdout and "hand  " in stdout
    Path("mine.py").write_text(good)
    code, stdout, stderr = call("run", "mine.py")
    assert code == 0 and "computing" not in stdout and "the data that were kept" in stderr
    code, stdout, _ = call("show", "mine.py")
    assert code == 0 and "mine.py when computed " in stdout and "FAILED" not in stdout
    Path("mine.py").write_text(good + "def claims(result): return result.data.hnad\n")
    assert call("run", "mine.py", "--force", "--set", "seed=7")[0] == 1
    code, stdout, _ = call("show", "mine.py")
    assert code == 0 and "The last run FAILED" in stdout and "seed   0" in stdout


@pytest.mark.parametrize("part", ["Config", "run", "figure", "claims"])
def test_a_file_that_lacks_a_part_is_refused_before_anything_is_computed(call, part):
    Path("mine.py").write_text(GOOD + f"\ndel {part}\n")
    code, stdout, stderr = call("run", "mine.py", "good")
    assert code == 2 and not stdout
    assert f"mine.py: has no {part}; an experiment defines " in stderr
    assert not Path("results").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("class Config: pass", "its Config is no dataclass"),
        ("run = 3", "has no run; an experiment defines run(config) -> jc.experiments.Result"),
        (
            "from dataclasses import make_dataclass\n"
            "Config = make_dataclass('Config', [('seed', int)], frozen=True)",
            "every setting of its Config needs a default",
        ),
    ],
)
def test_a_file_with_a_wrong_part_is_refused(call, more, said):
    Path("mine.py").write_text(f"{GOOD}\n{more}\n")
    code, _, stderr = call("run", "mine.py")
    assert code == 2 and said in stderr


def test_a_file_without_quick_settings_says_so_when_they_are_wanted(call):
    plain = "from dataclasses import make_dataclass\nConfig = make_dataclass('Config', [])\n"
    Path("mine.py").write_text(GOOD + plain)
    code, _, stderr = call("run", "mine.py", "--quick")
    assert code == 2 and "the Config of mine has no class method quick()" in stderr


def test_a_setting_that_is_no_scalar_cannot_be_set(call):
    more = "from dataclasses import field, make_dataclass\n"
    more += "Config = make_dataclass('Config', [('at', tuple, field(default=()))], frozen=True)\n"
    Path("mine.py").write_text(GOOD + more)
    code, _, stderr = call("run", "mine.py", "--set", "at=1")
    assert code == 2 and "at is neither int, float, bool nor str" in stderr


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("def run(config): return 3", "TypeError: run: a jc.experiments.Result is wanted, got int"),
        ("def figure(result): pass", "figure: a matplotlib Figure is wanted, got NoneType"),
        ("def claims(result): return [1]", "claims: a list of jc.experiments.Claim is wanted"),
        ("def run(config): return 1 / 0", "ZeroDivisionError: division by zero"),
    ],
)
def test_a_file_that_fails_or_returns_something_else_is_a_failure_of_its_own(call, more, said):
    Path("mine.py").write_text(f"{GOOD}\n{more}\n")
    code, stdout, _ = call("run", "mine.py", "good")
    assert code == 1 and said in stdout and "\ngood" in stdout


def test_a_file_that_raises_on_import_is_a_failure_with_its_own_line(call):
    Path("mine.py").write_text("import jaxctrl\nraise RuntimeError('no arm')\n")
    code, stdout, stderr = call("run", "mine.py", "good")
    assert code == 1 and "mine: failed: RuntimeError: no arm" in stdout
    assert 'mine.py", line 2' in stderr and "\ngood" in stdout


def test_a_file_may_import_what_lies_beside_it_and_has_its_own_types(call):
    Path("beside_mine.py").write_text("FACTOR = 3\n")
    Path("mine.py").write_text(
        f"from __future__ import annotations\n{GOOD}\nimport beside_mine\n"
        "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Config:\n"
        "    seed: int = beside_mine.FACTOR\n"
    )
    code, _, stderr = call("run", "mine.py", "--set", "seed=x")
    assert code == 2 and "seed wants int, got 'x'" in stderr
    assert call("run", "mine.py")[0] == 0
    assert json.loads(Path("results/mine/config.json").read_text()) == {"seed": 3}


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("far/lst.py", "lst.py: there is no such file; did you mean the experiment 'last'?"),
        ("min.py", "min.py: there is no such file; did you mean 'mine.py'?"),
        ("mine", "no experiment 'mine': did you mean the file 'mine.py'?"),
        ("far/away.py", "far/away.py: there is no such file"),
        ("good.py", "good.py: its results would be called 'good', as another experiment's are"),
        ("all.py", "all.py: its results would be called 'all'"),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused_with_what_is_near(call, word, said):
    for name in ("mine.py", "good.py", "all.py"):
        Path(name).write_text(GOOD)
    code, stdout, stderr = call("run", word)
    assert code == 2 and said in stderr and not stdout and not Path("results").exists()


def test_two_files_of_one_name_cannot_share_a_folder(call):
    Path("other").mkdir()
    for name in ("mine.py", "other/mine.py"):
        Path(name).write_text(GOOD)
    code, _, stderr = call("run", "mine.py", "other/mine.py")
    assert code == 2 and "its results would be called 'mine'" in stderr


def test_from_python_a_file_is_a_module(call):
    Path("mine.py").write_text(GOOD)
    assert jc.experiments.load("mine.py").Config().seed == 0
    with pytest.raises(ValueError, match="there is no such file"):
        jc.experiments.load("yours.py")
