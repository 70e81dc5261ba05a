"""Time the solvers on the benchmark's problems, beside other programs and the bars they set.

Run by `make bench`; `--quick` is a trial of a minute. All figures come from one run on one
machine: absolute times mean little on another. Each process of JAX compiles loops in one manner,
so the two manners ("fast", by `jc.enable_fast_cpu`, and "default") are two processes.

A solve's tolerances are chosen such that all stop by one rule: the first to end within 1e-6,
relatively, of the solver's own limit. All costs are computed anew by `Case.cost`.
"""

import argparse
import json
import math
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from others import measure_others
from problems import cases
from report import Figures, add_success, bars, best_costs, tables
from stopwatch import CORES

HERE = Path(__file__).resolve().parent
FULL = {"firsts": 3, "repeats": 25, "restarts": 100, "batches": 3}
QUICK = {"firsts": 1, "repeats": 3, "restarts": 4, "batches": 1}
# What a user may have set that would change what is measured.
UNSET = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "JAX_NUM_CPU_DEVICES")


def arguments() -> argparse.Namespace:
    """Read the command line."""
    known = list(cases())
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"problems, of {' '.join(known)}")
    parser.add_argument("--quick", action="store_true", help="P2 alone, few repetitions, no peers")
    parser.add_argument("--flags", choices=("both", "fast", "default"), default="both")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--no-peers", action="store_true", help="leave other programs out")
    given = parser.parse_args()
    unknown = set(given.names) - set(known)
    if unknown:
        parser.error(f"{' '.join(sorted(unknown))}: unknown problem; there are {' '.join(known)}")
    wanted = given.names or (["P2"] if given.quick else known)
    given.names = [name for name in known if name in wanted]
    return given


def note(record: dict[str, Any]) -> None:
    """Show that a figure has come."""
    words = [record.get(key) for key in ("section", "mode", "problem", "solver")]
    print(" ".join(filter(None, words)), file=sys.stderr, flush=True)


def run_child(orders: dict[str, Any]) -> list[dict[str, Any]]:
    """Measure our solvers in a process of their own; return its records."""
    environment = {key: value for key, value in os.environ.items() if key not in UNSET}
    environment["JAX_PLATFORMS"] = "cpu"
    child = subprocess.Popen(
        [sys.executable, HERE / "measure.py"], text=True, env=environment,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert child.stdin is not None and child.stdout is not None
    with child:
        child.stdin.write(json.dumps(orders))
        child.stdin.close()
        records = []
        for line in child.stdout:
            records.append(json.loads(line))
            note(records[-1])
    if child.returncode != 0:
        sys.exit(f"measure.py ({orders['mode']}) failed with exit status {child.returncode}")
    return records


def collect(given: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Measure everything: ours with fast flags, the others, ours with default flags."""
    settings = QUICK if given.quick else FULL
    records, missing, chosen = [], {}, {}

    def keep(record: dict[str, Any]) -> None:
        note(record)
        records.append(record)

    for stage in ("fast", "peers", "default"):
        if stage == "peers":
            if not (given.no_peers or given.quick):
                missing = measure_others(given.names, settings, keep)
        elif given.flags in ("both", stage):
            orders = {"mode": stage, "names": given.names, "chosen": chosen, **settings}
            # A trial need not compile everything twice.
            orders["singles_alone"] = given.quick and bool(chosen)
            for record in run_child(orders):
                if record["section"] == "chosen":
                    chosen[record["problem"]] = record["chosen"]
                else:
                    records.append(record)
    return records, missing


def machine() -> dict[str, Any]:
    """Describe where this runs."""
    cores = len(CORES) or os.cpu_count()
    return {"system": platform.platform(), "processor": processor(), "cores": cores}


def processor() -> str:
    """Return the processor's name as far as the system tells it."""
    described = Path("/proc/cpuinfo")
    if described.is_file():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def strict(value: Any) -> Any:
    """Replace what JSON has no word for by null."""
    if isinstance(value, dict):
        return {key: strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [strict(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    """Measure, and print the tables."""
    given = arguments()
    records, missing = collect(given)
    best = best_costs(records, {name: cases()[name].best for name in given.names})
    add_success(records, best)
    restarts = (QUICK if given.quick else FULL)["restarts"]
    held = list(bars(Figures(records), given.names, restarts))
    here = machine()
    print(f"{here['processor']}, {here['cores']} cores; {here['system']}\n")
    print(tables(records, held, missing))
    if given.json is not None:
        everything = {
            "machine": here, "best": best, "records": records, "bars": held, "missing": missing,
        }  # fmt: skip
        given.json.write_text(json.dumps(strict(everything), indent=1) + "\n")


if __name__ == "__main__":
    main()
