"""The command line: list the experiments, run them, show what came out, and time the solvers.

JAX and its friends are imported by the commands that need them, so that `--help`, `--version` and
`list` answer at once.

Exit codes: 0 all is well; 1 an experiment failed, a result cannot be trusted or something is
slower than it was; 2 wrong usage, or a folder or file that cannot be used; 130 interrupted.
"""

import contextlib
import dataclasses
import io
import os
import signal
import sys
import textwrap
import typing
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import click

from . import bench as benchmarks, experiments
from ._cpu import enable_fast_cpu
from ._version import __version__

if TYPE_CHECKING:
    from .experiments._result import Claim
    from .experiments._runner import Outcome

WIDTH = 100
"""Columns of what is written about claims."""

_TYPES: dict[type, click.ParamType] = {
    int: click.INT,
    float: click.FLOAT,
    bool: click.BOOL,
    str: click.STRING,
}


class _Unusable(click.ClickException):
    """Refuse a folder or a file before anything is computed."""

    exit_code = 2


_out = click.option(
    "--out",
    type=click.Path(path_type=Path),
    default="results",
    show_default=True,
    help="Folder of the results.",
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    streams = [s for s in (sys.stdout, sys.stderr) if isinstance(s, io.TextIOWrapper)]
    for stream in streams:  # a terminal that knows no Greek must not end a run
        stream.reconfigure(errors="replace")
    try:
        code = jaxctrl.main(arguments, prog_name="jaxctrl", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        say("interrupted", err=True)
        code = 130
    if code == 130:  # a thread that is still inside XLA must not delay the end
        with contextlib.suppress(OSError):
            for stream in streams:
                stream.flush()
        os._exit(code)
    sys.exit(code or 0)


def say(text: str, err: bool = False, nl: bool = True) -> None:
    """Print a text, with colours only on a terminal and without NO_COLOR.

    When the reader has gone (`| head`), the rest is said to nobody and the work goes on.
    """
    try:
        click.echo(text, err=err, nl=nl, color=False if os.environ.get("NO_COLOR") else None)
    except BrokenPipeError:
        nobody = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nobody, (sys.stderr if err else sys.stdout).fileno())
        os.close(nobody)


@click.group()
@click.version_option(__version__)
def jaxctrl() -> None:
    """Optimal control of biological and robotic movement: run the published experiments."""


@jaxctrl.command("list")
def list_experiments() -> None:
    """List the experiments with one line each."""
    say(_table([(name, line) for name, (_, line) in experiments.EXPERIMENTS.items()]))


@jaxctrl.command()
@click.argument("words", metavar="NAME | FILE.py | all...", nargs=-1, required=True)
@click.option("--quick", is_flag=True, help="Small settings that show the same in seconds.")
@_out
@click.option("--set", "pairs", metavar="KEY=VALUE", multiple=True, help="Change one setting.")
@click.option("--force", is_flag=True, help="Compute again and replace what is there.")
def run(words: tuple[str, ...], quick: bool, out: Path, pairs: tuple[str, ...], force: bool) -> int:
    """Run experiments and write their data, figures and claims.

    An experiment is one of `jaxctrl list`, or a file of your own that defines Config, run, figure
    and claims, such as my_experiment.py. Each gets a folder of its own in the results folder. Those
    that are already finished with the same settings are skipped, so that an interrupted run is
    resumed by repeating it.
    """
    _check_experiments(words, "all")
    every = experiments.names() if "all" in words else []
    own = {experiments.resolve(word): word for word in words if word != "all"}
    chosen = [*every, *(own[name] if own[name].endswith(".py") else name for name in own)]
    chosen = list(dict.fromkeys(chosen))
    with _terminable():
        import jax
        import matplotlib

        with warnings.catch_warnings():  # a program that calls `main` may have used JAX before
            warnings.simplefilter("ignore")
            enable_fast_cpu()
        jax.config.update("jax_enable_x64", True)
        matplotlib.use("Agg")
        from .experiments import _file, _runner, _store

        try:
            outcomes = _runner.run_many(
                chosen,
                lambda name, module: _configure(name, module, quick, pairs),
                out,
                force=force,
                report=lambda text, nl=True: say(text, err=True, nl=nl),
            )
        except (_store.StoreError, _file.FileError) as error:
            raise _Unusable(str(error)) from error
        say(_scoreboard(outcomes))
        return _runner.exit_code(outcomes)


@jaxctrl.command()
@click.argument("word", metavar="NAME | FILE.py")
@_out
def show(word: str, out: Path) -> int:
    """Show settings, claims and variables of a finished experiment, and verify its files."""
    _check_experiments([word])
    name = experiments.resolve(word)
    from .experiments import _store

    try:
        kept = _store.unfinished(out, name)
        alone = kept is not None and not _store.locate(out, name).exists()
        found = kept if kept and alone else _store.read(out, name)
    except _store.StoreError as error:
        raise click.ClickException(str(error)) from error
    made = ", ".join(f"{package} {version}" for package, version in found.manifest.versions.items())
    say(f"{name}: {experiments.describe(word)}")
    say(f"made by {made} in {found.manifest.wall_seconds} s; all files of {found.folder} are whole")
    if found.manifest.failure and not alone:
        say(f"FAILED: {found.manifest.failure}")
    if kept:
        say(f"The last run FAILED: {kept.manifest.failure}")
        say(f"Its data are whole, in {kept.folder / 'result.nc'}: mend the figure or the claims,")
        say(f"and `jaxctrl run {word}` with the same settings goes on from there.")
    say("\nSettings")
    say(_table([(key, str(value)) for key, value in found.config.items()]))
    say("\nClaims")
    for claim in found.claims:
        say(_block(claim, source=claim.source, note=claim.note))
    say("\nVariables")
    rows = [
        (
            str(key),
            " × ".join(f"{dim} {size}" for dim, size in variable.sizes.items()),
            variable.attrs.get("units", ""),
            variable.attrs["long_name"],
        )
        for key, variable in found.data().variables.items()
    ]
    say(_table([("name", "shape", "units", "meaning"), *rows]))
    return int(alone)


@jaxctrl.command()
@click.argument("suites", metavar="[SUITE]...", nargs=-1)
@click.option("--quick", is_flag=True, help="Small settings: less than a minute for each suite.")
@click.option("--peers", is_flag=True, help="Time other programs too, also in `problems`.")
@click.option("--save", metavar="FILE", type=click.Path(path_type=Path), help="Save all figures.")
@click.option(
    "--against", metavar="FILE", type=click.Path(path_type=Path), help="Compare with a saved run."
)
def bench(
    suites: tuple[str, ...], quick: bool, peers: bool, save: Path | None, against: Path | None
) -> int:
    """Time the solvers: suites thesis, peers, scaling, problems, or all of them.

    Other programs (peers) are timed from a checkout of the repository alone, whose folder
    benchmarks/ has them. With --against, exits with 1 when something is slower than in the saved
    run.
    """
    for name in suites:
        _check_word("suite", name, benchmarks.SUITES)
    from .bench import _files, _peers, _run

    chosen = [name for name in benchmarks.SUITES if name in suites or not suites]
    if not suites and not peers:
        try:
            _peers.folder()
        except _peers.Absent as error:
            chosen.remove("peers")
            say(f"left out peers: {error}", err=True)
    with _terminable():
        try:
            return _run.run(
                chosen,
                quick=quick,
                peers=peers,
                save=save,
                against=against,
                report=lambda text: say(text, err=True),
                show=say,
            )
        except (_files.FileError, _peers.Absent) as error:
            raise _Unusable(str(error)) from error


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM interrupt like Ctrl-C inside a `with` block."""

    def interrupt(*_: Any):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def _check_word(kind: str, word: str, words: Iterable[str]) -> None:
    """Raise a usage error with the nearest word when a word is not known."""
    if word not in words:
        raise click.UsageError(experiments.unknown(kind, word, words))


def _check_experiments(words: Sequence[str], *more: str) -> None:
    """Raise a usage error for words that name no experiment and no file of one."""
    try:
        experiments.check(words, *more)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _configure(name: str, module: ModuleType, quick: bool, pairs: Sequence[str]) -> Any:
    """Build the Config of an experiment from the options `--quick` and `--set`."""
    if quick and not hasattr(module.Config, "quick"):
        raise click.UsageError(f"--quick: the Config of {name} has no class method quick()")
    try:
        config = module.Config.quick() if quick else module.Config()
    except TypeError as error:
        raise click.UsageError(f"{name}: every setting of its Config needs a default") from error
    types = typing.get_type_hints(module.Config)
    changes = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise click.UsageError(f"--set {pair}: write it as key=value")
        _check_word(f"setting of {name}", key, [field.name for field in dataclasses.fields(config)])
        if types[key] not in _TYPES:
            raise click.UsageError(f"--set {pair}: {key} is neither int, float, bool nor str")
        try:
            changes[key] = _TYPES[types[key]].convert(value, None, None)
        except click.BadParameter as error:
            wanted = types[key].__name__
            raise click.UsageError(f"--set {pair}: {key} wants {wanted}, got {value!r}") from error
    try:
        return dataclasses.replace(config, **changes)
    except ValueError as error:
        raise click.UsageError(f"--set: {error}") from error


def _scoreboard(outcomes: "Iterable[Outcome]") -> str:
    """Return each experiment's claims, and a line for each experiment that has none to show."""
    lines = []
    for outcome in outcomes:
        if outcome.claims:
            hold = sum(claim.holds for claim in outcome.claims)
            lines.append(f"{outcome.name}: {hold} of {len(outcome.claims)} claims hold")
            lines += [_block(claim) for claim in outcome.claims]
        if outcome.state not in ("finished", "skipped"):
            lines.append(f"{outcome.name}: {outcome.state}: {outcome.detail}".rstrip(": "))
    return "\n".join(lines)


def _block(claim: "Claim", **further: str) -> str:
    """Write a claim as yes or NO with its statement, and below what was expected and measured."""
    verdict = click.style("yes", fg="green") if claim.holds else click.style("NO", fg="red") + " "
    parts = {"expected": claim.expected, "measured": claim.measured, **further}
    below = [_wrapped(f"{name + ':':<10}{text}") for name, text in parts.items() if text]
    return "\n".join([verdict + _wrapped(claim.statement)[3:], *below])


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, initial_indent=" " * 5, subsequent_indent=" " * 5)


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of cells in columns, each cell on one line."""
    rows = [[" ".join(cell.split()) for cell in row] for row in rows]
    full = [row for row in rows if len(row) == max(map(len, rows))]
    widths = [
        max(len(click.unstyle(cell)) for cell in column) for column in zip(*full, strict=True)
    ]
    return "\n".join(
        "  ".join(
            cell + " " * (width - len(click.unstyle(cell)))
            for cell, width in zip(row, widths, strict=False)
        ).rstrip()
        for row in rows
    )
