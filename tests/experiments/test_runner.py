"""A run goes on after a failure, repeats nothing, and keeps what is finished."""

import json
import shutil
import sys

import fake_experiments as fake
import pytest

from jaxctrl import experiments
from jaxctrl.experiments import _runner, _store


@pytest.fixture
def use(monkeypatch):
    """Return a function that installs fake experiments."""

    def use(*names, **overrides):
        monkeypatch.setattr(experiments, "EXPERIMENTS", {})
        modules = {}
        fake.install(names, experiments.EXPERIMENTS, modules)
        for name, module in modules.items():
            key = name.removeprefix("fake_")
            monkeypatch.setitem(sys.modules, name, overrides.get(key, module))

    return use


def run(out, *, config=None, force=False):
    lines = []
    outcomes = _runner.run_many(
        experiments.names(),
        lambda name, module: config or module.Config(),
        out,
        force=force,
        report=lambda text, nl=True: lines.append(text + "\n" * nl),
    )
    return outcomes, "".join(lines)


def states(outcomes):
    return [outcome.state for outcome in outcomes]


def files(out):
    return {
        path.relative_to(out): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != ".jaxctrl.lock"
    }


def test_a_failure_does_not_stop_the_others(use, tmp_path):
    use("raises", "good", "fails", "last")
    outcomes, text = run(tmp_path)
    assert states(outcomes) == ["failed", "finished", "failed", "finished"]
    assert outcomes[0].detail == "RuntimeError: the arm fell off"
    assert "Traceback" in text and "raise_error" in text
    assert not (tmp_path / "raises").exists()
    assert _runner.exit_code(outcomes) == 1


def test_a_module_that_cannot_be_imported_is_a_failure_of_its_own(use, tmp_path, monkeypatch):
    use("good")
    monkeypatch.setitem(experiments.EXPERIMENTS, "absent", ("jaxctrl_absent", "Not there"))
    outcomes, _ = run(tmp_path)
    assert states(outcomes) == ["finished", "failed"]
    assert "jaxctrl_absent" in outcomes[1].detail


def unsavable(result):
    drawn = fake.figure(result)
    drawn.suptitle("$\\frac$")  # is read when the figure is saved
    return drawn


UNDRAWN = [("figure", fake.raise_error), ("claims", fake.raise_error), ("figure", unsavable)]


@pytest.mark.parametrize(("part", "broken"), UNDRAWN)
def test_data_outlive_a_failure_to_draw_or_judge_and_are_used_again(use, tmp_path, part, broken):
    use("good", good=fake.fake(**{part: broken}))
    (failed,), _ = run(tmp_path)
    assert failed.state == "failed" and "data are kept in" in failed.detail and failed.trace
    assert str(tmp_path / "good.unfinished" / "result.nc") in failed.detail
    assert {path.parts[0] for path in files(tmp_path)} == {"good.unfinished"}
    kept = _store.unfinished(tmp_path, "good")
    assert kept.data().equals(fake.result(fake.Config()).data)
    assert failed.detail.startswith(kept.manifest.failure)
    use("good", good=fake.fake(fake.raise_error))  # computes no more
    (finished,), _ = run(tmp_path)
    assert finished.state == "finished" and "the data that were kept" in finished.detail
    assert states(run(tmp_path)[0]) == ["skipped"]
    again = files(tmp_path)
    use("good")
    run(tmp_path / "other")
    fresh = _store.read(tmp_path / "other", "good")
    assert {path.name for path in again} == {path.name for path in fresh.folder.iterdir()}
    assert _store.read(tmp_path, "good").data().identical(fresh.data())
    assert _store.read(tmp_path, "good").claims == fresh.claims


def test_kept_data_of_other_settings_are_refused_and_computed_anew_on_request(use, tmp_path):
    use("good", good=fake.fake(figure=fake.raise_error))
    run(tmp_path)
    (refused,), _ = run(tmp_path, config=fake.Config(seed=3))
    assert refused.state == "refused" and "seed is 0 there and 3 here; --force" in refused.detail
    (failed,), _ = run(tmp_path, config=fake.Config(seed=3), force=True)
    assert failed.state == "failed"
    assert _store.unfinished(tmp_path, "good").config["seed"] == 3
    use("good")
    (finished,), _ = run(tmp_path, force=True)
    assert finished.state == "finished" and "kept" not in finished.detail
    assert {path.parts[0] for path in files(tmp_path)} == {"good"}


def test_a_failure_to_draw_leaves_what_is_finished_alone(use, tmp_path):
    use("good")
    run(tmp_path)
    use("good", good=fake.fake(figure=fake.raise_error))
    assert states(run(tmp_path, config=fake.Config(seed=3), force=True)[0]) == ["failed"]
    assert _store.read(tmp_path, "good").config["seed"] == 0
    assert states(run(tmp_path)[0]) == ["skipped"]
    use("good", good=fake.fake(fake.raise_error))
    assert states(run(tmp_path, config=fake.Config(seed=3))[0]) == ["finished"]
    assert _store.read(tmp_path, "good").config["seed"] == 3


def test_a_result_that_reports_failure_still_does_when_its_data_were_kept(use, tmp_path):
    use("fails", fails=fake.fake(fake.FAKES["fails"].run, figure=fake.raise_error))
    run(tmp_path)
    use("fails", fails=fake.fake(fake.raise_error))
    (failed,), _ = run(tmp_path)
    assert failed.state == "failed" and failed.detail == "ILQR stopped at its maximum of steps"
    assert _store.read(tmp_path, "fails").manifest.failure == failed.detail


def test_damaged_kept_data_are_refused(use, tmp_path):
    use("good", good=fake.fake(figure=fake.raise_error))
    run(tmp_path)
    flip(tmp_path / "good.unfinished")
    (refused,), _ = run(tmp_path)
    assert refused.state == "refused" and "result.nc: changed" in refused.detail


def test_data_that_cannot_be_kept_are_no_second_failure(use, tmp_path):
    use("good", good=fake.fake(figure=fake.raise_error))
    (tmp_path / "good.unfinished").mkdir()
    (tmp_path / "good.unfinished" / "notes.txt").write_text("mine")
    (failed,), _ = run(tmp_path, force=True)
    assert failed.state == "failed" and "the arm fell off" in failed.detail
    assert "notes.txt: not a file of jaxctrl" in failed.detail


def test_a_setting_that_cannot_be_stored_fails_before_computing(use, tmp_path):
    use("stuck")
    outcomes, _ = run(tmp_path, config=fake.Config(label=()))  # type: ignore[arg-type]
    assert "Config.label must be" in outcomes[0].detail


def test_a_result_that_reports_failure_is_kept_and_reported_again(use, tmp_path):
    use("fails")
    first, second = run(tmp_path)[0][0], run(tmp_path)[0][0]
    assert (first.state, second.state) == ("failed", "failed")
    assert first.detail == "ILQR stopped at its maximum of steps"
    assert second.detail.endswith(first.detail)
    assert first.claims == second.claims
    assert _store.read(tmp_path, "fails").manifest.failure == first.detail


def test_what_is_finished_is_not_computed_again(use, tmp_path):
    use("good", "last")
    first, _ = run(tmp_path)
    before = files(tmp_path)
    use("good", "last", good=fake.fake(fake.raise_error), last=fake.fake(fake.raise_error))
    second, text = run(tmp_path)
    assert states(second) == ["skipped", "skipped"]
    assert [outcome.claims for outcome in second] == [outcome.claims for outcome in first]
    assert "good skipped because it is already finished" in text
    assert files(tmp_path) == before
    assert _runner.exit_code(second) == 0


def test_an_infinite_setting_is_recognised_as_the_same(use, tmp_path):
    use("good")
    for state in ("finished", "skipped"):
        assert states(run(tmp_path, config=fake.Config(gain=float("nan")))[0]) == [state]


def test_other_settings_are_refused_and_computed_on_request(use, tmp_path):
    use("good")
    run(tmp_path)
    outcomes, _ = run(tmp_path, config=fake.Config(seed=3))
    assert states(outcomes) == ["refused"]
    assert "seed is 0 there and 3 here; --force" in outcomes[0].detail
    assert _runner.exit_code(outcomes) == 1
    assert states(run(tmp_path, config=fake.Config(seed=3), force=True)[0]) == ["finished"]
    assert _store.read(tmp_path, "good").config["seed"] == 3


def test_an_older_version_is_refused_and_computed_on_request(use, tmp_path, monkeypatch):
    use("good")
    with monkeypatch.context() as older:
        older.setattr(_store, "__version__", "0.0.1")
        run(tmp_path)
    outcomes, _ = run(tmp_path)
    assert states(outcomes) == ["refused"]
    assert "made by jaxctrl 0.0.1" in outcomes[0].detail
    assert states(run(tmp_path, force=True)[0]) == ["finished"]
    assert states(run(tmp_path)[0]) == ["skipped"]


def truncate(folder):
    (folder / "result.nc").write_bytes((folder / "result.nc").read_bytes()[:100])


def flip(folder):
    content = bytearray((folder / "result.nc").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "result.nc").write_bytes(content)


def unfinish(folder):
    (folder / "done.json").unlink()


@pytest.mark.parametrize("damage", [truncate, flip, unfinish])
def test_a_damaged_experiment_is_refused_and_computed_on_request(use, tmp_path, damage):
    use("good", "last")
    run(tmp_path)
    before = _store.read(tmp_path, "good").data()
    damage(tmp_path / "good")
    outcomes, _ = run(tmp_path)
    assert states(outcomes) == ["refused", "skipped"]
    assert str(tmp_path / "good") in outcomes[0].detail
    assert "--force" in outcomes[0].detail
    assert states(run(tmp_path, force=True)[0]) == ["finished", "finished"]
    assert before.identical(_store.read(tmp_path, "good").data())


def test_force_leaves_foreign_files_alone_without_computing(use, tmp_path):
    use("good", "stuck")
    run_first = tmp_path / "good"
    run_first.mkdir()
    (run_first / "thesis.tex").write_text("mine")
    (tmp_path / "stuck").write_text("mine")
    outcomes, _ = run(tmp_path, force=True)
    assert states(outcomes) == ["refused", "refused"]
    assert "thesis.tex" in outcomes[0].detail
    assert "--force" not in outcomes[0].detail
    assert (run_first / "thesis.tex").read_text() == "mine"


def test_an_interruption_keeps_the_finished_and_leaves_out_the_rest(use, tmp_path):
    def interrupt(config):
        raise KeyboardInterrupt

    use("good", "waits", "last", waits=fake.fake(interrupt))
    outcomes, text = run(tmp_path)
    assert states(outcomes) == ["finished", "interrupted", "not run"]
    assert "interrupted" in text
    assert _runner.exit_code(outcomes) == 130
    use("good", "waits", "last")
    assert states(run(tmp_path)[0]) == ["skipped", "finished", "finished"]


def test_wrong_settings_pass_through_before_anything_is_touched(use, tmp_path):
    def refuse(name, module):
        raise ValueError(name)

    use("good")
    with pytest.raises(ValueError, match="good"):
        _runner.run_many(["good"], refuse, tmp_path / "out", report=print)
    assert not (tmp_path / "out").exists()


def test_an_unusable_folder_is_refused_before_computing(use, tmp_path):
    use("stuck")
    (tmp_path / "file").write_text("")
    with pytest.raises(_store.StoreError, match="file: cannot write"):
        run(tmp_path / "file")


def test_a_terminal_sees_one_live_line_and_a_log_sees_plain_ones(use, tmp_path, monkeypatch):
    use("good")
    _, plain = run(tmp_path / "plain")
    assert plain.startswith("[1/1] good started\n[1/1] good finished in ")
    assert "\r" not in plain
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    _, live = run(tmp_path / "live")
    assert live.startswith("\r[1/1] good 0 s\r[1/1] good finished in ")
    assert live.count("\n") == 1


def test_an_unknown_name_is_answered_with_the_nearest(use):
    use("good", "last")
    with pytest.raises(ValueError, match="no experiment 'goood': did you mean 'good'"):
        experiments.load("goood")
    with pytest.raises(ValueError, match="no experiment 'xyz': choose from good, last"):
        experiments.load("xyz")


def test_a_copied_results_folder_is_as_good_as_the_first(use, tmp_path):
    use("good")
    run(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert states(run(tmp_path / "b")[0]) == ["skipped"]
    assert json.loads((tmp_path / "b" / "good" / "done.json").read_text())["experiment"] == "good"
