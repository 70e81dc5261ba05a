"""Lay the figures of a run out as text: a line as each row comes, tables at the end of a suite."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ._judgement import Judgement

Record = dict[str, Any]
WORDS = (
    "problem",
    "solver",
    "method",
    "status",
    "what",
    "by",
    "",
    "suite",
    "claim",
    "note",
    "system",
)
UNDER_NOISE = (
    "Six muscles under noise, warm, on one core (reaches inside jitted calls; trials and the batch "
    "called from Python)"
)
FAR = 1e-3
"""A cost is called worse from so far, relatively, above the best."""
MEMORY_BAR = 4096.0
"""Most memory for 4096 solves of the muscle arm [MiB]."""


def table(title: str, rows: Iterable[Sequence[str]]) -> str:
    """Lay out a table, its first row the heads; words to the left and numbers to the right."""
    rows = list(rows)
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    words = [i for i, head in enumerate(rows[0]) if head in WORDS]
    lines = [
        "  ".join(
            cell.ljust(width) if i in words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return "\n".join([title, "-" * len(title), *lines, ""])


def text(value: Any, form: str = "") -> str:
    """Write a figure, or a dash where there is none."""
    return "-" if value is None else format(value, form)


def _milliseconds(timing: Record | None) -> tuple[str, str]:
    """Write a median and its spread."""
    if timing is None:
        return "-", "-"
    return f"{timing['ms']:.4g}", f"{timing['low_ms']:.4g} to {timing['high_ms']:.4g}"


def live(record: Record) -> str | None:
    """Return the line of one record as it comes, or None for one that has none."""
    if record["section"] in ("missing", "chosen", "claim", "table"):
        return None
    what = [record["suite"], record["section"], record["problem"], record.get("solver", "")]
    if record["section"] == "failure":
        return f"{record['suite']:<9} FAILED {record['problem']}: {record['reason']}"
    ms, spread = _milliseconds(record.get("timing"))
    if record.get("total_ms") is not None and "timing" not in record:
        ms, spread = f"{record['total_ms']:.4g}", "in all"
    line = "{:<9} {:<10} {:<22} {:<33}".format(*what)
    line += f" {record['mode']:<8} {record['dtype']}  {ms:>9} ms ({spread})"
    return line + (f", {record['status']}" if record.get("status") else "")


def worse(record: Record, best: float | None) -> str:
    """Say how much worse a cost is than the best, where that is more than 0.1 %."""
    cost = record.get("cost")
    if cost is None:
        return "no finite cost"
    if not best or cost / best - 1 <= FAR:
        return ""
    return f"worse by {100 * (cost / best - 1):.3g} %"


def singles(
    records: Sequence[Record], best: dict[str, float],
    title: str = "One solve, warm, inside one jitted call, on one core (cpu ms: processor time; "
    "eager: that of a call from Python; first calls compile, on all cores)",
) -> str:  # fmt: skip
    """Return the table of all single solves of a suite."""
    heads = (
        "problem", "solver", "flags", "dtype", "ms", "10-90 %", "cpu ms", "eager",
        "first s", "iter.", "ms/iter.", "cost", "note",
    )  # fmt: skip
    rows = []
    for r in records:
        timing, count = r.get("timing"), r.get("iterations")
        each = timing["cpu_ms"] / count if timing and count else None
        notes = [worse(r, best.get(r["problem"], r.get("optimum"))), r.get("note", "")]
        if r.get("gap") and r["gap"] > 1e-5:
            notes.append(f"{r['gap']:.1e} above its limit")
        fine = r.get("ok", True) and (r.get("status") or "CONVERGED").startswith("CONVERGED")
        notes.append("" if fine else str(r.get("status") or "not converged"))
        rows.append(
            [
                *(r[name] for name in ("problem", "solver", "mode", "dtype")),
                *_milliseconds(timing), text(timing and timing["cpu_ms"], ".4g"),
                text(r.get("eager_ms"), ".3f"), text(r.get("first_s"), ".2f"), text(count, "g"),
                text(each, ".4f"), text(r.get("cost"), ".7e"), "; ".join(filter(None, notes)),
            ]
        )  # fmt: skip
    return table(title, [heads, *rows])


def restarts(records: Sequence[Record]) -> str:
    """Return the table of restarts."""
    heads = (
        "problem", "solver", "flags", "dev.", "total ms", "/ one", "success", "by cost",
        "iter. med", "max", "first s",
    )  # fmt: skip
    rows = [
        [
            r["problem"], r["solver"], r["mode"], text(r.get("devices")),
            text(r.get("total_ms"), ".1f"), text(r.get("of_one"), ".1f"),
            text(r.get("success"), ".2f"), text(r.get("by_cost"), ".2f"),
            text(r.get("iterations_median"), "g"), text(r.get("iterations_max")),
            text(r.get("first_s"), ".2f"),
        ]
        for r in records
    ]  # fmt: skip
    return table("Restarts (jaxctrl: 2 devices, all cores; Crocoddyl: 1 thread)", [heads, *rows])


def gradients(records: Sequence[Record]) -> str:
    """Return the table of gradients."""
    heads = (
        "problem", "solver", "flags", "iteration ms", "cost ms", "/ iter.", "traject. ms",
        "/ iter.", "handing ms", "finite",
    )  # fmt: skip
    rows = [
        [
            r["problem"], r["solver"], r["mode"],
            *(text(r.get(k), ".4f") for k in ("iteration_ms", "cost_ms")), text(r["cost"], ".2f"),
            text(r.get("trajectory_ms"), ".4f"), text(r["trajectory"], ".2f"),
            text(r.get("handing_ms"), ".4f"), "yes" if r.get("finite") else "NO",
        ]
        for r in records
    ]  # fmt: skip
    title = (
        "Gradients beyond the forward solve, in iterations of ILQR (`handing`: what JAX takes to "
        "return so many arrays, contained in both)"
    )
    return table(title, [heads, *rows])


def bars(held: Sequence[Record]) -> str:
    """Return the table of bars."""
    rows = []
    for bar in held:
        sign = ">=" if bar["least"] else "<="
        shown = [text(bar["figure"], ".3g"), f"{sign} {bar['bar']:g}", bar["verdict"]]
        rows.append([bar["what"], bar["problem"], bar["by"], *shown])
    return table("Bars", [("what", "problem", "by", "figure", "bar", ""), *rows])


def batches(records: Sequence[Record]) -> str:
    """Return the table of batches."""
    heads = ("problem", "dtype", "total ms", "10-90 %", "ms each", "memory MiB", "converged", "")
    rows = []
    for r in records:
        held = ""
        if r["size"] == 4096:
            held = "met" if r["memory_mib"] <= MEMORY_BAR else "MISSED"
            held += f": at most {MEMORY_BAR:.0f} MiB"
        rows.append(
            [
                r["problem"], r["dtype"], *_milliseconds(r["timing"]), f"{r['each_ms']:.3f}",
                f"{r['memory_mib']:.0f}", f"{r['converged']} of {r['size']}", held,
            ]
        )  # fmt: skip
    return table("Batches of the muscle arm's reaches, by solve_batch", [heads, *rows])


def _exponents(rows: Sequence[Record]) -> Iterator[tuple[str, ...]]:
    """Yield the exponents of time per iteration in the horizon and in the number of links."""
    series: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in rows:
        if row["suite"] == "scaling" and row["section"] == "single":
            what, number = row["problem"].rsplit(" ", 1)
            points = series.setdefault((what, row["solver"], row["dtype"]), [])
            points.append((float(number), row["timing"]["cpu_ms"] / max(1, row["iterations"])))
    for (what, solver, dtype), points in series.items():
        if len({number for number, _ in points}) > 1:
            over, times = np.log(np.array(points)).T
            ends = f"{points[0][0]:.0f} to {points[-1][0]:.0f}"
            yield what, solver, dtype, ends, f"{np.polyfit(over, times, 1)[0]:.2f}"


def summary(rows: Sequence[Record], held: Sequence[Record], best: dict[str, float]) -> str:
    """Return the tables of one suite."""
    sections: dict[str, list[Record]] = {}
    for row in rows:
        sections.setdefault(row["section"], []).append(row)
    order: dict[str, Callable[[list[Record]], str]] = {
        "table": lambda r: table("Table 4.1", r[0]["rows"]),
        "single": lambda r: singles(_in_order(r), best),
        "noise": lambda r: singles(r, {}, UNDER_NOISE),
        "batch": batches, "restarts": restarts, "gradients": gradients,
        "claim": _claims,
    }  # fmt: skip
    if "table" in sections:  # it has the single solves already
        del order["single"]
    parts = [write(sections[name]) for name, write in order.items() if name in sections]
    exponents = list(_exponents(rows))
    if exponents:
        heads = ("what", "solver", "dtype", "from", "exponent")
        parts.append(table("Time per iteration ~ number^exponent", [heads, *exponents]))
    return "\n".join([*parts, *([bars(held)] if held else [])])


def _claims(records: Sequence[Record]) -> str:
    """Return each claim with its verdict and, on lines of their own, what was said and measured."""
    lines = ["Claims", "------"]
    for c in records:
        lines.append(f"{'yes' if c['holds'] else 'NO ':<3}  {c['statement']}")
        parts = (("expected", c["expected"]), ("measured", c["measured"]), ("note", c["note"]))
        lines += [f"     {name}: {words}" for name, words in parts if words]
    return "\n".join([*lines, ""])


def _in_order(records: Sequence[Record]) -> list[Record]:
    """Sort single solves by problem as these came, ours before others."""
    problems = list(dict.fromkeys(record["problem"] for record in records))
    return sorted(records, key=lambda r: (problems.index(r["problem"]), r["mode"] == "peer"))


def comparison(judged: Sequence[Judgement], old: Record, new: Record, lone: Sequence[str]) -> str:
    """Return the table of `--against`, and what else differs between the two runs."""
    heads = ("suite", "problem", "solver", "flags", "dtype", "old ms", "new ms", "ratio",
             "threshold", "")  # fmt: skip
    rows = []
    for j in judged:
        suite, section, problem, solver, mode, dtype = j.name
        name = problem if section == "single" else f"{problem} ({section})"
        times = [f"{row['timing']['ms']:.4g}" for row in (j.old, j.new)]
        rows.append(
            [suite, name, solver, mode, dtype, *times, f"{j.ratio:.3f}", f"{j.threshold:.2f}",
             j.verdict]
        )  # fmt: skip
    title = (
        "Against the earlier run (ratio: processor time in units of the calibration; old and new "
        "ms are wall times)"
    )
    notes = [
        f"different {kind}: {key} was {old.get(kind, {}).get(key)}, is {new[kind].get(key)}"
        for kind in ("machine", "versions")
        for key in {**old.get(kind, {}), **new[kind]}
        if old.get(kind, {}).get(key) != new[kind].get(key)
    ]
    if old.get("quick") != new["quick"]:
        notes.append("one of the two runs is quick, the other is not")
    if not old.get("complete"):
        notes.append("the earlier run is incomplete")
    return "\n".join([table(title, [heads, *rows]), *notes, *lone])
