"""Print both solvers' results on each case: `python tests/oracle/table.py [quick] [slow] [hard]`.

"lower" and "upper" count the controls at a bound; "improvement" is what IPOPT takes off the cost,
relative to it, when started from jaxctrl's solution.
"""

import sys

import jax
import oracle_cases
from comparison import Comparison, compare

HEAD = (
    f"{'problem':40s} {'T':>3s} {'nx':>2s} {'nu':>2s} {'lower':>5s} {'upper':>5s}  "
    f"{'jaxctrl':18s} {'it':>3s} {'s':>5s}  {'IPOPT':16s} {'it':>3s} {'s':>5s} "
    f"{'jaxctrl cost':>17s} {'IPOPT cost':>17s} {'improvement':>11s}"
)


def row(name: str, result: Comparison) -> str:
    """Return a line of the table."""
    solution = result.solution
    num_steps, nu = solution.us.shape
    return (
        f"{name:40s} {num_steps:3d} {solution.xs.shape[1]:2d} {nu:2d} "
        f"{result.num_lower:5d} {result.num_upper:5d}  "
        f"{solution.status.name:18s} {int(solution.num_steps):3d} {result.seconds[0]:5.1f}  "
        f"{result.outcome.status[:16]:16s} {result.outcome.num_steps:3d} {result.seconds[1]:5.1f} "
        f"{result.cost:17.10e} {result.found_cost:17.10e} {result.improvement:11.1e}"
    )


def main(groups: list[str]) -> None:
    """Print the groups of cases named, by default the quick and the slow ones."""
    jax.config.update("jax_enable_x64", True)
    print(HEAD)
    for group in groups or ["quick", "slow"]:
        for name, case in getattr(oracle_cases, group.upper()).items():
            print(row(name, compare(case())), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
