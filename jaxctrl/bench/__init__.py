"""Benchmarks: suites of timed solves, beside other programs, saved and compared with earlier runs.

`jaxctrl bench` runs them. Every process of JAX compiles loops in one manner and has one dtype, so
all measuring is done in child processes; nothing here imports JAX before they do. The other
programs and their suite are in benchmarks/peers of the repository.
"""

SUITES = {
    "thesis": "Table 4.1: ILQR beside the thesis's rivals, with its claims; times under noise",
    "peers": "Single solves, restarts and gradients beside compiled programs and their bars",
    "scaling": "Time over horizon, links and batch size, for both dtypes",
    "problems": "Every problem of the library by ILQR and DDP",
}
"""Name of each suite and one line about it."""
