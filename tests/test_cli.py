"""The command line answers at once, names what is wrong, and survives being killed."""

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import fake_experiments as fake
import pytest

from jaxctrl import cli, experiments
from jaxctrl.experiments import _store

FAKE = Path(fake.__file__)
EVERY = tuple(fake.FAKES)


def environment(names=EVERY, **extra):
    """Return the environment of a command line with fake experiments."""
    return {
        **os.environ,
        "FAKE_NAMES": " ".join(names),
        "PYTHONPATH": os.pathsep.join(sys.path),
    } | extra


def start(*arguments, names=EVERY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **extra):
    return subprocess.Popen(
        [sys.executable, FAKE, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        env=environment(names, **extra),
        encoding="utf-8",
        errors="replace",
    )


def finish(process):
    stdout, stderr = process.communicate(timeout=60)
    return process.returncode, stdout, stderr


def wait_for(process, text):
    """Read the progress until a line has the text."""
    for line in process.stderr:
        if text in line:
            return
    raise AssertionError(f"no {text!r}")


@pytest.fixture
def call(monkeypatch, capsys):
    """Return a function that calls the command line in this process, with fake experiments."""

    def call(*arguments, names=EVERY):
        monkeypatch.setattr(experiments, "EXPERIMENTS", {})
        modules = {}
        fake.install(names, experiments.EXPERIMENTS, modules)
        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, name, module)
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in arguments])
        return end.value.code, *capsys.readouterr()

    return call


def made_by_jaxctrl(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != ".jaxctrl.lock")


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["list"], ["run", "--help"]])
def test_help_version_and_list_import_nothing_heavy(arguments):
    script = (
        "import sys\n"
        "from jaxctrl.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "finally: print(*sys.modules, file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0
    assert done.stdout
    heavy = {"jax", "jaxlib", "equinox", "matplotlib", "xarray", "numpy", "filelock"}
    assert not heavy & set(done.stderr.split())


def test_version_is_that_of_the_package(call):
    code, stdout, _ = call("--version")
    assert code == 0
    assert stdout == f"jaxctrl, version {cli.__version__}\n"


def test_list_names_every_experiment_on_one_line(call):
    code, stdout, _ = call("list", names=("good", "last"))
    assert (code, stdout) == (0, "good  What good does\nlast  What last does\n")


def test_the_registry_has_a_name_a_module_and_a_line_for_each():
    for name, (module, line) in experiments.EXPERIMENTS.items():
        assert module == f"jaxctrl.experiments.{name.replace('-', '_').replace('.', '_')}"
        assert line and "\n" not in line


def test_a_figure_that_another_experiment_draws_is_run_and_shown_as_that(
    call, monkeypatch, tmp_path
):
    monkeypatch.setattr(experiments, "ALIASES", {"twin": "good"})
    code, stdout, _ = call("run", "twin", "good", "--out", tmp_path)
    assert code == 0 and made_by_jaxctrl(tmp_path) == ["good"], stdout
    code, stdout, _ = call("show", "twin", "--out", tmp_path)
    assert code == 0 and "good: What good does" in stdout


def test_every_alias_leads_to_an_experiment():
    assert set(experiments.ALIASES.values()) <= set(experiments.EXPERIMENTS)
    assert not set(experiments.ALIASES) & set(experiments.EXPERIMENTS)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "goood"], "no experiment 'goood': did you mean 'good'?"),
        (["run", "good", "als"], "no experiment 'als': did you mean"),
        (["show", "lst"], "no experiment 'lst': did you mean 'last'?"),
        (["run", "good", "--quik"], "--quick"),
        (["run", "good", "--set", "sed=3"], "no setting of good 'sed': did you mean 'seed'?"),
        (["run", "good", "--set", "seed"], "write it as key=value"),
        (["run", "good", "--set", "seed=1.5"], "seed wants int, got '1.5'"),
        (["run", "good", "--set", "gain=much"], "gain wants float, got 'much'"),
        (["run", "good", "--set", "noisy=maybe"], "noisy wants bool, got 'maybe'"),
        (["run", "good", "--set", "gain=-1"], "gain must not be negative"),
        (["run"], "Missing argument"),
        (["show", "good", "last"], "unexpected extra argument"),
        (["nonsense"], "No such command 'nonsense'"),
    ],
)
def test_wrong_usage_exits_2_and_names_what_is_near(call, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = call(*arguments)
    assert code == 2
    assert said in stderr
    assert not stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", ["file", "file/below", "/dev/null"])
def test_an_unusable_folder_exits_2_before_computing(call, tmp_path, place):
    (tmp_path / "file").write_text("")
    code, _, stderr = call("run", "stuck", "--out", tmp_path / place)
    assert code == 2
    assert f"{place}: cannot write into this folder" in stderr
    assert "started" not in stderr


def test_settings_are_parsed_by_their_types(call, tmp_path):
    changes = ["seed=3", "gain=1e-3", "label=a=b", "noisy=no"]
    options = [option for change in changes for option in ("--set", change)]
    assert call("run", "good", "--quick", "--out", tmp_path, *options)[0] == 0
    config = _store.read(tmp_path, "good").config
    assert config == {"seed": 3, "gain": 0.001, "label": "a=b", "noisy": False}


def test_quick_uses_the_quick_settings(call, tmp_path):
    assert call("run", "good", "--quick", "--out", tmp_path)[0] == 0
    assert _store.read(tmp_path, "good").config["seed"] == 1


def test_a_claim_that_does_not_hold_is_shown_and_is_no_error(call, tmp_path):
    code, stdout, stderr = call("run", "good", "good", "--out", tmp_path)
    assert code == 0
    assert stdout.splitlines() == [
        "good: 1 of 2 claims hold",
        "yes  the path is straight",
        "     expected: < 1 m",
        "     measured: 0.2 m",
        "NO   the hand stops",
        "     expected: 0 m/s",
        "     measured: 0.1 m/s",
    ]
    assert stderr.startswith("[1/1] good started\n")


def test_a_failed_experiment_exits_1_and_is_on_the_scoreboard(call, tmp_path):
    names = ("raises", "fails", "last")
    code, stdout, _ = call("run", "all", "--out", tmp_path, names=names)
    assert code == 1
    assert "raises: failed: RuntimeError: the arm fell off\n" in stdout
    assert "\nfails: failed: ILQR stopped at its maximum of steps\n" in stdout
    assert "\nlast: 1 of 2 claims hold\nyes  the path is straight\n" in stdout
    assert max(map(len, stdout.splitlines())) <= 100
    assert made_by_jaxctrl(tmp_path) == ["fails", "last"]


def test_show_prints_settings_claims_and_variables(call, tmp_path):
    call("run", "good", "--out", tmp_path, "--set", "label=über  the top")
    code, stdout, _ = call("show", "good", "--out", tmp_path)
    assert code == 0
    for text in ("label  über the top", "fig. 1", "θ drifts", "NO", "are whole"):
        assert text in stdout
    assert "\nhand  time 5 × axis 2  m      position of the hand\n" in stdout
    assert "\naxis  axis 2                  axis in space\n" in stdout


def test_show_says_that_a_result_failed(call, tmp_path):
    call("run", "fails", "--out", tmp_path)
    assert "FAILED: ILQR stopped" in call("show", "fails", "--out", tmp_path)[1]


def test_show_refuses_a_damaged_or_absent_experiment(call, tmp_path):
    call("run", "good", "--out", tmp_path)
    path = tmp_path / "good" / "result.nc"
    path.write_bytes(path.read_bytes()[:-1])
    code, stdout, stderr = call("show", "good", "--out", tmp_path)
    assert (code, stdout) == (1, "")
    assert "result.nc: has" in stderr
    code, _, stderr = call("show", "last", "--out", tmp_path)
    assert code == 1
    assert "missing, so this is no finished experiment" in stderr


def test_sigterm_has_its_former_meaning_after_a_run(call, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    call("run", "good", "--out", tmp_path)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("number", "victim", "moment", "code"),
    [
        (signal.SIGINT, "waits", "waits started", 130),
        (signal.SIGTERM, "waits", "waits started", 130),
        (signal.SIGKILL, "waits", "waits started", -signal.SIGKILL),
        (signal.SIGTERM, "saves", "saving", 130),
        (signal.SIGKILL, "saves", "saving", -signal.SIGKILL),
    ],
)
def test_a_killed_run_keeps_what_is_finished_and_is_resumed(
    call, tmp_path, number, victim, moment, code
):
    names = ("good", victim, "last")
    process = start("run", "all", "--out", tmp_path, names=names, FAKE_WAIT="1")
    wait_for(process, moment)
    process.send_signal(number)
    returned, stdout, _ = finish(process)
    assert returned == code
    finished = _store.read(tmp_path, "good")
    assert not (tmp_path / victim).exists() and not (tmp_path / "last").exists()
    if code == 130:
        assert f"\n{victim}" in stdout and "interrupted" in stdout and "not run" in stdout
        assert made_by_jaxctrl(tmp_path) == ["good"]
    code, _, stderr = call("run", "all", "--out", tmp_path, names=names)
    assert code == 0
    assert "good skipped because it is already finished" in stderr
    assert made_by_jaxctrl(tmp_path) == sorted(names)
    assert _store.read(tmp_path, "good").manifest == finished.manifest
    expected = fake.result(fake.Config()).data
    for name in names:
        assert _store.read(tmp_path, name).data().equals(expected)


def test_an_interruption_is_answered_while_compiled_code_runs(tmp_path):
    process = start("run", "stuck", "--out", tmp_path)
    wait_for(process, "stuck started")
    time.sleep(0.2)
    asked = time.monotonic()
    process.send_signal(signal.SIGINT)
    returned, _, stderr = finish(process)
    assert returned == 130
    assert time.monotonic() - asked < 30  # the call itself takes 60 s
    assert "Traceback" not in stderr


def test_two_runs_cannot_write_into_one_folder(call, tmp_path):
    process = start("run", "waits", "--out", tmp_path, FAKE_WAIT="1")
    wait_for(process, "waits started")
    code, _, stderr = call("run", "good", "--out", tmp_path)
    assert code == 2
    assert f"{tmp_path}: another run is writing into this folder" in stderr
    process.kill()
    finish(process)
    assert call("run", "good", "--out", tmp_path)[0] == 0


def test_a_disk_that_fills_up_fails_one_experiment_and_leaves_no_part_of_it(tmp_path):
    arguments = ("run", "large", "last", "--out", tmp_path)
    code, stdout, _ = finish(start(*arguments, FAKE_LIMIT="2000000"))
    assert code == 1
    assert "large: failed: OSError" in stdout
    assert made_by_jaxctrl(tmp_path) == ["last"]
    _store.read(tmp_path, "last")


@pytest.mark.parametrize("arguments", [["list"], ["--help"], ["run", "--help"]])
def test_a_reader_that_has_gone_leaves_no_traceback(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    process = start(*arguments, stdout=writer)
    os.close(writer)
    assert finish(process)[2] == ""


def test_list_through_head_prints_one_line_and_nothing_else():
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; '{sys.executable}' '{FAKE}' list | head -n 1"],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "good     What good does\n", "")


def test_a_run_is_finished_in_float64_when_nobody_reads_its_progress(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    process = start("run", "precise", "--out", tmp_path, stdout=writer, stderr=writer)
    os.close(writer)
    assert finish(process)[0] == 0
    assert _store.read(tmp_path, "precise").manifest.failure == ""


def read_terminal(*arguments, **extra):
    """Run the command line on a terminal and return what it shows there."""
    ours, theirs = pty.openpty()
    process = start(*arguments, stdout=theirs, stderr=theirs, **extra)
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 4096):
            shown += part
    except OSError:  # Linux says so when the other side has gone
        pass
    os.close(ours)
    assert process.wait(timeout=60) == 0
    return shown.decode()


def test_colours_are_for_terminals_without_no_color(call, tmp_path):
    call("run", "good", "--out", tmp_path)
    coloured = {"NO_COLOR": "", "TERM": "xterm"}
    assert "\x1b[31mNO\x1b[0m" in read_terminal("show", "good", "--out", tmp_path, **coloured)
    plain = read_terminal("show", "good", "--out", tmp_path, NO_COLOR="1", TERM="xterm")
    assert "NO" in plain and "\x1b" not in plain
    assert "\x1b" not in call("show", "good", "--out", tmp_path)[1]


def test_a_terminal_without_greek_shows_what_it_can(call, tmp_path):
    call("run", "good", "--out", tmp_path)
    process = start("show", "good", "--out", tmp_path, PYTHONIOENCODING="latin-1")
    code, stdout, stderr = finish(process)
    assert (code, stderr) == (0, "")
    assert "? drifts" in stdout
