"""Run suites in child processes, show what comes, save it, and compare it with an earlier run."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from . import _bars, _files, _judgement, _layout, _peers, _plans

# What a user may have set that would change what is measured.
UNSET = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "JAX_NUM_CPU_DEVICES")
Report = Callable[[str], None]


class _Failed(Exception):
    """Report a process that ended before its time."""


def run(
    suites: Sequence[str], *, quick: bool, peers: bool, save: Path | None, against: Path | None,
    report: Report, show: Report,
) -> int:  # fmt: skip
    """Run suites and return the exit code of the command.

    Arguments:
        suites: their names, in the order to be run.
        quick: small settings.
        peers: other programs too, where that makes sense.
        save: file for all figures; written after every suite.
        against: file of an earlier run.
        report: called with each line of progress.
        show: called with each table.

    Returns 0; 1 when something is slower than it was or a measurement failed; 130 when
    interrupted, with what was measured saved.

    Raises, before anything is measured: FileError for files that cannot be used, and Absent where
    other programs are asked for and this is no checkout.
    """
    if peers or "peers" in suites:
        _peers.folder()
    old = None if against is None else _files.load(against)
    if save is not None:
        _files.check_writable(save)
    session = Session(_files.header(list(suites), quick), save, old, report, show)
    here = session.run["machine"]
    show(f"{here['processor']}, {here['cores']} cores; {here['system']}\n")
    try:
        for suite in suites:
            session.suite(suite, quick, peers or suite == "peers")
        session.run["complete"] = True
    except KeyboardInterrupt:
        where = ""
        if save is not None and session.run["rows"]:
            where = f": what was measured is in {_files.incomplete(save)}"
        report("interrupted" + where)
        return 130
    finally:
        session.write()
    return session.end()


class Session:
    """One run: its figures so far, and where they go."""

    def __init__(
        self, run: dict[str, Any], save: Path | None, old: dict[str, Any] | None, report: Report,
        show: Report,
    ):  # fmt: skip
        self.run, self.save, self.old, self.report, self.show = run, save, old, report, show

    def write(self) -> None:
        """Save what there is, if it is to be saved: an earlier run is not lost to half of one."""
        if self.save is None:
            return
        partial = _files.incomplete(self.save)
        if self.run["complete"]:
            _files.save(self.save, self.run)
            partial.unlink(missing_ok=True)
        elif self.run["rows"]:
            _files.save(partial, self.run)

    def suite(self, suite: str, quick: bool, peers: bool) -> None:
        """Measure one suite and show its tables."""
        jobs, rows, chosen = _plans.jobs(suite, quick, peers), self.run["rows"], {}
        start = len(rows)
        for job in jobs:
            self.job(job.orders, chosen, rows.append)
        if self.save is not None or self.old is not None:  # only comparisons need more processes
            for _ in range(jobs[0].orders["processes"] - 1):
                self.again(jobs, chosen, start)
        if self.old is not None and any(j.verdict == "slower" for j in self.judged(start)):
            # A false alarm is rarer than one slow hour: what looks slower is measured once more.
            self.report(f"{suite}: something looks slower, measuring again")
            for _ in range(jobs[0].orders["processes"]):
                self.again(jobs, chosen, start)
        mine, held, best = rows[start:], [], {}
        if suite == "peers":
            bars = _peers.load("bars")
            best = bars.best_costs(mine)
            bars.add_success(mine, best)
            names = list(dict.fromkeys(row["problem"] for row in mine))
            held = list(bars.bars(bars.Figures(mine), names, jobs[0].orders["restarts"]))
        elif suite == "thesis":
            held = list(_bars.of_noise(mine))
        if held:
            self.run.setdefault("bars", []).extend(held)
        self.show(_layout.summary(mine, held, best))
        self.write()

    def again(self, jobs: Sequence[_plans.Job], chosen: dict[str, Any], start: int) -> None:
        """Measure the judged times in one more process each, and pool them with the others."""
        for job in jobs:
            if job.again is not None:
                more: list[dict[str, Any]] = []
                self.job(job.again, chosen, more.append)
                _judgement.merge(self.run["rows"][start:], more)

    def job(
        self, orders: dict[str, Any], chosen: dict[str, Any], keep: Callable[[Any], None]
    ) -> None:
        """Let one process measure; what it reports goes to its place."""
        try:
            _child({**orders, "chosen": chosen}, lambda record: self.take(record, chosen, keep))
        except _Failed as error:
            self.fail(f"{orders['suite']} {orders['mode']} {orders['dtype']}", str(error))

    def take(
        self, record: dict[str, Any], chosen: dict[str, Any], keep: Callable[[Any], None]
    ) -> None:
        """Put one record where it belongs, and show it."""
        line = _layout.live(record)
        if line is not None:
            self.report(line)
        if record["section"] == "missing":
            self.run["missing"] |= record["missing"]
        elif record["section"] == "chosen":
            chosen[record["problem"]] = record["chosen"]
        elif record["section"] == "failure":
            self.run["failures"][f"{record['suite']} {record['problem']}"] = record["reason"]
        else:
            keep(record)

    def fail(self, what: str, reason: str) -> None:
        """Note a measurement that failed."""
        self.report(f"FAILED {what}: {reason}")
        self.run["failures"][what] = reason

    def judged(self, start: int = 0) -> list[_judgement.Judgement]:
        """Compare what was measured from a row on with the earlier run."""
        old = [] if self.old is None else self.old["rows"]
        return list(_judgement.judge_all(old, self.run["rows"][start:]))

    def end(self) -> int:
        """Show what is missing, what failed and what has changed; return the exit code."""
        for name, reason in self.run["missing"].items():
            self.show(f"not here: {name}: {reason}")
        for name, reason in self.run["failures"].items():
            self.show(f"FAILED: {name}: {reason}")
        slower = False
        if self.old is not None:
            judged = self.judged()
            slower = any(j.verdict == "slower" for j in judged)
            self.show(_layout.comparison(judged, self.old, self.run, self.lone(judged)))
        return int(slower or bool(self.run["failures"]))

    def lone(self, judged: Sequence[_judgement.Judgement]) -> list[str]:
        """Return a line for each timed row of these suites that only one of the runs has."""
        common = {j.name for j in judged}
        runs = (("earlier", self.old or {"rows": []}), ("present", self.run))
        return [
            f"only in the {which} run: {' '.join(_judgement.key(row))}"
            for which, run in runs
            for row in run["rows"]
            if row.get("suite") in self.run["suites"]
            and "timing" in row
            and _judgement.key(row) not in common
        ]


def _child(orders: dict[str, Any], take: Callable[[dict[str, Any]], None]) -> None:
    """Measure in a process of its own; hand over each of its records.

    Raises: _Failed with the last line that it said, when it does not end well.
    """
    environment = {key: value for key, value in os.environ.items() if key not in UNSET}
    # One core solves: threads of a linear algebra library would wait for one another there.
    environment |= {"JAX_PLATFORMS": "cpu", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+", errors="replace") as said:
        child = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}._worker"], text=True, env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said,
        )  # fmt: skip
        assert child.stdin is not None and child.stdout is not None
        try:
            child.stdin.write(json.dumps(orders))
            child.stdin.close()
            for line in child.stdout:
                take(json.loads(line))
            code = child.wait()
        finally:
            child.kill()
            child.wait()
            child.stdout.close()
        if code != 0:
            said.seek(0)
            lines = said.read().strip().splitlines()
            raise _Failed(f"exit status {code}: {lines[-1][:300] if lines else 'no message'}")
