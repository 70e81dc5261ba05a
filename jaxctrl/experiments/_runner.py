"""Run experiments one after the other: go on after a failure, resume, and stop when told to."""

import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from jaxctrl import __version__

from . import _file, _store, load, resolve
from ._result import Claim, Result

State = Literal["finished", "skipped", "failed", "refused", "interrupted", "not run"]
"""What can become of an experiment. A `skipped` one had been finished before."""


@dataclass(frozen=True)
class Outcome:
    """Hold what became of one experiment of a run.

    Arguments:
        name: of the experiment.
        state: see `State`.
        detail: how long it took, or the reason of a failure or refusal.
        claims: of a finished or skipped experiment, and of one that reports its own failure.
        trace: the whole traceback of an exception.
    """

    name: str
    state: State
    detail: str = ""
    claims: tuple[Claim, ...] = ()
    trace: str = ""


@dataclass(frozen=True)
class Job:
    """Hold what is to be run: the experiment's module, its `Config`, a file's fingerprint."""

    module: ModuleType
    config: Any
    own: dict[str, str]


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """Return 130 after an interruption, 1 when an experiment failed or was refused, 0 otherwise."""
    states = {outcome.state for outcome in outcomes}
    if "interrupted" in states:
        return 130
    return int(not states <= {"finished", "skipped"})


def run_many(
    words: Sequence[str],
    configure: Callable[[str, ModuleType], Any],
    out: Path,
    *,
    force: bool = False,
    report: Callable[..., None],
) -> list[Outcome]:
    """Run experiments one after the other and return what became of each.

    One that fails does not stop the others, one that is already finished is skipped, and after a
    KeyboardInterrupt the rest is left out.

    Arguments:
        words: names of experiments, or paths of files (`*.py`).
        configure: gives the `Config` from a name and its module; what it raises passes through,
            before anything is computed.
        out: results folder, created when missing.
        force: compute again what is already there.
        report: called with each line of progress, and with `nl=False` for an incomplete one.

    Raises, before anything is computed: StoreError when the folder cannot be used, FileError for a
    file that is no experiment.
    """
    jobs: dict[str, Job | Outcome] = {}
    for word in words:
        name = resolve(word)
        try:
            module = load(word)
        except _file.FileError:
            raise
        except Exception as error:
            jobs[name] = _failed(name, error)
        else:
            own = _file.fingerprint(word) if _file.is_file(word) else {}
            jobs[name] = Job(module, configure(name, module), own)
    outcomes: list[Outcome] = []
    with _store.locked(out):
        try:
            for name, job in jobs.items():
                tick, end = _progress(f"[{len(outcomes) + 1}/{len(jobs)}] {name}", report)
                ready = isinstance(job, Job)
                outcome = run_one(name, job, out, force=force, tick=tick) if ready else job
                outcomes.append(outcome)
                end(outcome)
        except KeyboardInterrupt:
            left = list(jobs)[len(outcomes) :]
            outcomes += [Outcome(name, "interrupted") for name in left[:1]]
            outcomes += [Outcome(name, "not run") for name in left[1:]]
            report("\ninterrupted: the same command resumes")
    return outcomes


def run_one(
    name: str,
    job: Job,
    out: Path,
    *,
    force: bool = False,
    tick: Callable[[float], None] = lambda seconds: None,
) -> Outcome:
    """Run one experiment and write its folder, unless it is already finished.

    The caller holds `_store.locked(out)`. An exception of the experiment becomes the state
    `failed`; where only drawing or judging failed, the data are kept, and are used by the next run
    with the same settings; a folder with something else in it becomes the state `refused`.

    Arguments:
        job: what to run.
        force: compute again, and replace what is there.
        tick: called with the seconds that have passed, from 0 on, while the experiment runs.
    """
    try:
        folder = _store.locate(out, name)
        kept = None if force else _kept(out, name, job)
        if force:
            _store.check_ours(folder)
        elif kept is None and folder.exists():
            return _compare(_store.read(out, name), job)
    except _store.StoreError as error:
        return Outcome(name, "refused", f"{error}{'' if force else '; --force recomputes it'}")
    return _run(name, job, out, kept, tick)


def _run(
    name: str, job: Job, out: Path, kept: _store.Finished | None, tick: Callable[[float], None]
) -> Outcome:
    """Compute, unless data were kept, then draw, judge and write; keep the data if that fails."""
    start, computed = time.monotonic(), 0.0
    tick(0.0)
    result = None
    # an own file may have changed since the kept data were computed: both fingerprints are recorded
    past = _changed(kept, job) if kept else {}
    try:
        _store.settings(job.config)
        if kept:
            result, computed = kept.result(job.config), kept.manifest.wall_seconds
        else:
            result = _in_background(lambda: _compute(job), tick, start)
            computed = time.monotonic() - start
        presented = time.monotonic()
        figure, claims = _in_background(lambda: _present(job, result), tick, start)
        total = computed + time.monotonic() - presented
        own = job.own | {f"{file} when computed": digest for file, digest in past.items()}
        _store.write(out, name, result, figure, claims, total, own)
    except Exception as error:
        failed = _failed(name, error)
        return failed if result is None else _keep(out, failed, result, computed, job.own | past)
    if result.failure:
        return Outcome(name, "failed", result.failure, tuple(claims))
    reused = ", with the data that were kept: only drawn and judged anew" if kept else ""
    return Outcome(name, "finished", f"in {time.monotonic() - start:.1f} s{reused}", tuple(claims))


def _keep(out: Path, failed: Outcome, result: Result, seconds: float, own: dict) -> Outcome:
    """Keep the data of a result that could not be drawn, judged or saved, and say where."""
    try:
        folder = _store.keep(out, failed.name, result, failed.detail, seconds, own)
    except Exception as error:
        return replace(failed, detail=f"{failed.detail}; its data could not be kept: {error}")
    return replace(
        failed,
        detail=f"{failed.detail}; its data are kept in {folder / 'result.nc'}: mend the figure or "
        "the claims, and the same command goes on from there (--force computes anew)",
    )


def _kept(out: Path, name: str, job: Job) -> _store.Finished | None:
    """Return what an unfinished run with the same settings and version kept, if there is any.

    Raises: StoreError when what is there was made differently and nothing else is finished.
    """
    found = _store.unfinished(out, name)
    differences = _differences(found, job) if found else []
    if found and differences and not _store.locate(out, name).exists():
        raise _store.StoreError(
            f"{found.folder}: data of an unfinished run, made differently: {'; '.join(differences)}"
        )
    return None if differences else found


def _compute(job: Job) -> Result:
    """Run an experiment.

    Raises: TypeError for what is no result.
    """
    result = job.module.run(job.config)
    if not isinstance(result, Result):
        raise TypeError(f"run: a jc.experiments.Result is wanted, got {type(result).__name__}")
    return result


def _present(job: Job, result: Result) -> tuple[Any, list[Claim]]:
    """Draw the figure of a result and judge its claims.

    Raises: TypeError for what is no figure or list of claims.
    """
    figure, claims = job.module.figure(result), job.module.claims(result)
    if not hasattr(figure, "savefig"):
        raise TypeError(f"figure: a matplotlib Figure is wanted, got {type(figure).__name__}")
    if not isinstance(claims, list) or not all(isinstance(claim, Claim) for claim in claims):
        raise TypeError(f"claims: a list of jc.experiments.Claim is wanted, got {claims!r:.80}")
    return figure, claims


def _in_background(work: Callable[[], Any], tick: Callable[[float], None], start: float) -> Any:
    """Call a function in a thread, so that a signal is answered at once while XLA computes.

    After an interruption the thread is left to itself; it writes no files.
    """
    future: Future[Any] = Future()

    def run():
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    while not wait([future], timeout=0.5).done:
        tick(time.monotonic() - start)
    return future.result()


def _compare(found: _store.Finished, job: Job) -> Outcome:
    """Skip an experiment that is finished with the same settings and version; refuse another."""
    name = found.manifest.experiment
    differences = _differences(found, job)
    differences += [f"{file} has changed since" for file in _changed(found, job)]
    if differences:
        raise _store.StoreError(f"{found.folder}: finished differently: {'; '.join(differences)}")
    if found.manifest.failure:
        return Outcome(name, "failed", f"before: {found.manifest.failure}", found.claims)
    return Outcome(name, "skipped", "because it is already finished", found.claims)


def _differences(found: _store.Finished, job: Job) -> list[str]:
    """Return in words how settings and version there differ from those here."""
    config, version = _store.settings(job.config), found.manifest.versions["jaxctrl"]
    differences = [
        f"{key} is {found.config.get(key)!r} there and {config.get(key)!r} here"
        for key in config | found.config
        if config.get(key) != found.config.get(key)
    ]
    if version != __version__:
        differences.append(f"it was made by jaxctrl {version}, this is {__version__}")
    return differences


def _changed(found: _store.Finished, job: Job) -> dict[str, str]:
    """Return the files that have changed since, with their fingerprints of then."""
    then = found.manifest.versions
    return {file: then.get(file, "") for file, now in job.own.items() if then.get(file) != now}


def _failed(name: str, error: Exception) -> Outcome:
    """Turn an exception into an outcome with its first line and its traceback."""
    first = str(error).strip().partition("\n")[0]
    text = f"{type(error).__name__}: {first}" if first else type(error).__name__
    return Outcome(name, "failed", text, trace="".join(traceback.format_exception(error)))


def _progress(
    label: str, report: Callable[..., None]
) -> tuple[Callable[[float], None], Callable[[Outcome], None]]:
    """Return two functions that show that time passes, and how an experiment ended.

    On a terminal they write one line over and over, elsewhere two plain lines.
    """
    live = sys.stderr.isatty()
    start = "\r" if live else ""

    def tick(seconds: float):
        if live:
            report(f"{start}{label} {seconds:.0f} s", nl=False)
        elif not seconds:
            report(f"{label} started")

    def end(outcome: Outcome):
        report(f"{start}{label} {outcome.state} {outcome.detail}")
        if outcome.trace:
            report(outcome.trace.rstrip())

    return tick, end
