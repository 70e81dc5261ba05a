"""Many solves of one kind: on every device of a CPU one after another, on a GPU side by side."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import ArrayLike

from ._checks import check_array, check_instance, check_integer, is_concrete, shape_of
from ._controller import AffinePolicy
from ._estimator import OutputFeedback
from ._jit import jit
from ._problem import Problem
from ._solution import Solution
from ._solve import check_max_steps, solve
from ._solver import AbstractSolver

DEFAULT_MEMORY = 4e9
"""What a device is taken to have [bytes] that does not tell."""


def solve_batch(
    problem: Problem,
    solver: AbstractSolver,
    x0s: ArrayLike,
    uss: ArrayLike | AffinePolicy | OutputFeedback | None = None,
    *,
    max_steps: int = 500,
    chunk: int | None = None,
) -> Solution:
    """Solve one problem from many starts, or many problems: `vmap` of `solve`, arranged for speed.

    On a CPU a batch inside one loop would wait, in every iteration, for its slowest lane: here the
    lanes are solved one after another, shared among the CPU's devices (see `enable_fast_cpu`). On
    other devices they are solved side by side, as many at once as fit into the memory. Each lane's
    result is that of its own `solve`, with its own status.

    Arguments:
        problem: one problem, or a batch of them, every array with a leading axis B.
        solver: as in `solve`.
        x0s: starting states, shape (B, nx), or (nx,) for all.
        uss: starting controls, shape (B, T, nu), (T, nu) for all, or None for the nominal ones; or
            a policy, as in `solve`: one for all, or a batch, `solutions.policy`.
        max_steps: as in `solve`.
        chunk: how many lanes to solve side by side where that is done; by default as many as fit.

    Returns: `Solution` with a leading axis B; `best(solutions)` picks one. Differentiable.

    Raises ValueError or TypeError for what is not a problem, for wrong shapes, and when no argument
    has an axis B, or they differ in it. Lanes that fail raise nothing: read `status.ok`.
    """
    check_instance("problem", problem, Problem, "a jc.Problem is wanted")
    check_instance(
        "solver",
        solver,
        AbstractSolver,
        "a solver that iterates is wanted (BoundaryValue runs on the host, one problem at a time)",
    )
    chunk = None if chunk is None else check_integer("chunk", chunk, 1)
    max_steps = check_max_steps(max_steps)
    batched = problem.dt.ndim == 1
    one = jax.tree.map(lambda leaf: leaf[0], problem) if batched else problem
    sizes = {"problem": len(problem.dt)} if batched else {}
    lanes: list[Any] = [problem if batched else None, None, None]
    fixed: list[Any] = [None if batched else problem, None, None]
    for i, (name, value, rank) in enumerate((("x0s", x0s, 1), ("uss", uss, 2)), start=1):
        if value is None:
            continue
        if rank == 2 and isinstance(value, AffinePolicy | OutputFeedback):
            batch = value.us.ndim == 3
            (lanes if batch else fixed)[i] = value
            sizes |= {name: len(value.us)} if batch else {}
            continue
        single = (one.plant.nx,) if rank == 1 else (one.num_steps, one.plant.nu)
        shape = shape_of(value)
        if len(shape) == rank + 1:
            sizes[name] = shape[0]
            lanes[i] = check_array(name, value, (shape[0], *single))  # pyright: ignore
        else:
            hint = f"or (B, {', '.join(map(str, single))})"
            fixed[i] = check_array(name, value, single, hint)  # pyright: ignore
    if not sizes or len(set(sizes.values())) > 1 or 0 in sizes.values():
        got = ", ".join(f"{name} of {size}" for name, size in sizes.items()) or "no such axis"
        raise ValueError(
            f"x0s, uss: a leading axis B > 0 of lanes is wanted, x0s (B, {one.plant.nx}) or uss "
            f"(B, {one.num_steps}, {one.plant.nu}) or a batch of problems, the same B in each; "
            f"got {got}"
        )
    job = _Job(lanes, fixed, solver, max_steps)
    return _run(job, next(iter(sizes.values())), chunk)


class _Job(eqx.Module):
    """What is solved: the arguments that have lanes, those that all lanes share, and how."""

    lanes: list[Any]
    fixed: list[Any]
    solver: AbstractSolver
    max_steps: int = eqx.field(static=True)

    def solve(self, lane) -> Solution:
        """Solve one lane."""
        problem, x0, us = (f if v is None else v for v, f in zip(lane, self.fixed, strict=True))
        return solve(problem, self.solver, x0, us, max_steps=self.max_steps)


def _run(job: _Job, size: int, chunk: int | None) -> Solution:
    """Map a solve over lanes in the manner that suits the device."""
    devices = jax.devices()
    concrete = is_concrete(*jax.tree.leaves(eqx.filter(job, eqx.is_array)))
    if devices[0].platform == "cpu" and chunk is None:
        n = min(len(devices), size) if concrete else 1
        return _one_by_one(job) if n == 1 else _shared(job, size, tuple(devices[:n]))
    chunk = min(size, _chunk(job, devices[0]) if chunk is None else chunk)
    while True:
        try:
            solution = _side_by_side(job, chunk)
            return jax.block_until_ready(solution) if concrete else solution
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or chunk == 1:
                raise
            chunk = max(1, chunk // 2)
            warnings.warn(f"solve_batch: out of memory; now {chunk} lanes at once", stacklevel=3)


@jit
def _one_by_one(job: _Job) -> Solution:
    return jax.lax.map(job.solve, job.lanes)


@jit
def _side_by_side(job: _Job, chunk: int) -> Solution:
    return jax.lax.map(job.solve, job.lanes, batch_size=chunk)


@jit
def _shared(job: _Job, size: int, devices) -> Solution:
    """Share lanes evenly among devices; the last one is repeated to fill the last share."""
    n = len(devices)
    index = np.minimum(np.arange(n * -(-size // n)), size - 1)
    arrays, static = eqx.partition(job, eqx.is_array)
    whole = jax.tree.map(lambda leaf: leaf[index], arrays.lanes)

    def each(lanes, fixed):
        own = eqx.combine(eqx.tree_at(lambda j: j.fixed, arrays, fixed), static)
        return jax.lax.map(own.solve, lanes)

    mesh = Mesh(np.array(devices), ("lanes",))
    spec = PartitionSpec("lanes")
    mapped = jax.shard_map(
        each, mesh=mesh, in_specs=(spec, PartitionSpec()), out_specs=spec, check_vma=False
    )
    solution = mapped(whole, arrays.fixed)
    return jax.tree.map(lambda leaf: leaf[:size], solution)


def _chunk(job: _Job, device) -> int:
    """Estimate how many lanes fit into half of a device's memory."""
    solution = eqx.filter_eval_shape(job.solve, jax.tree.map(lambda leaf: leaf[0], job.lanes))
    (T, nu), nx = solution.us.shape, solution.xs.shape[1]
    # Sweeps and expansions keep some ten arrays of (nx + nu)^2 for each step.
    each = 10 * T * (nx + nu) ** 2 * solution.us.dtype.itemsize
    stats = device.memory_stats() or {}
    return max(1, int(0.5 * stats.get("bytes_limit", DEFAULT_MEMORY) / each))


def best(solutions: Solution) -> Solution:
    """Return the lane of lowest cost among those that converged.

    Where none did, the lowest finite cost, with its own status: look at `status.ok`. Works under
    jit and vmap.

    Raises TypeError for what is no `Solution`, ValueError for a single one.
    """
    if not isinstance(solutions, Solution):
        raise TypeError(
            f"solutions: what solve_batch returns is wanted, got a {type(solutions).__name__}"
        )
    if solutions.cost.ndim == 0:
        raise ValueError("solutions: a batch is wanted, as solve_batch returns, got one solution")
    shape = solutions.cost.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(shape) :]), solutions)
    cost = jnp.where(jnp.isnan(flat.cost), jnp.inf, flat.cost)
    converged = jnp.where(flat.status.ok, cost, jnp.inf)
    lane = jnp.argmin(jnp.where(flat.status.ok.any(), converged, cost))
    return jax.tree.map(lambda leaf: leaf[lane], flat)
