"""What controllers cost and how they end over many noisy trials, by Monte Carlo."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, ArrayLike, Float

from ._checks import check_integer, is_concrete
from ._controller import AbstractController
from ._jit import jit
from ._noise import AbstractNoise
from ._plant import AbstractHand, AbstractPlant
from ._problem import Problem
from ._simulate import check_key, simulate
from ._terms import SumCost, parts

CHUNK = 64
"""How many trials run side by side; more take no less time on a CPU, and more memory."""


class Evaluation(eqx.Module):
    """What came out of n trials of one controller.

    Attributes:
        costs: the cost of each trial, shape (n,). `cost` is their mean, `cost_error` its standard
            error.
        ends: the last state of each trial, (n, nx).
        hands: the hand's last position [m], (n, dim); None for a plant without a hand.
        misses: how far the hand ends from the nearest target of the problem's cost [m], (n,); None
            where the cost has none.
        collided: whether the hand met an obstacle of the problem's cost, at the grid's times or on
            the straight way between them, (n,) of bool; None where the cost has none.
        costs_without_obstacles: the cost of each trial without what obstacles add, (n,). With
            them the expectation may be infinite: what an `Obstacle` adds has no finite mean under
            any spread that reaches its rim.
        key: the data of the key that all trials share.
    """

    costs: Float[Array, " n"]
    ends: Float[Array, "n nx"]
    hands: Float[Array, "n dim"] | None
    misses: Float[Array, " n"] | None
    collided: Array | None
    costs_without_obstacles: Float[Array, " n"]
    key: Array | None = None

    @property
    def cost(self) -> Float[Array, ""]:
        """The mean cost, shape ()."""
        return jnp.mean(self.costs, axis=-1)

    @property
    def cost_error(self) -> Float[Array, ""]:
        """The standard error of the mean cost, shape ()."""
        return _error(self.costs)

    @property
    def end_mean(self) -> Float[Array, " nx"]:
        """The mean of the last state, shape (nx,)."""
        return jnp.mean(self.ends, axis=-2)

    @property
    def end_cov(self) -> Float[Array, "nx nx"]:
        """The covariance of the last state, shape (nx, nx)."""
        return _cov(self.ends)

    @property
    def hand_mean(self) -> Float[Array, " dim"]:
        """The mean of the hand's last position [m], shape (dim,)."""
        return jnp.mean(_wanted(self.hands, "hand"), axis=-2)

    @property
    def hand_cov(self) -> Float[Array, "dim dim"]:
        """The covariance of the hand's last position [m^2], shape (dim, dim)."""
        return _cov(_wanted(self.hands, "hand"))

    @property
    def collisions(self) -> Float[Array, ""]:
        """The fraction of trials in which the hand met an obstacle, shape ()."""
        return jnp.mean(_wanted(self.collided, "obstacle"), axis=-1)

    def hits(self, tolerance: ArrayLike) -> Float[Array, ""]:
        """Return the fraction of trials that end within a tolerance [m] of a target, shape ()."""
        return jnp.mean(_wanted(self.misses, "target") <= tolerance, axis=-1)

    def difference(self, other: "Evaluation") -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return by how much this costs more than another, and the standard error of that.

        Both of the same key and number of trials: trial by trial they met the same noise. A 95 %
        interval is the difference +- 1.96 of its standard errors.

        Raises TypeError for what is no evaluation, and ValueError for one of another number of
        trials, or, where they are known, of another key.
        """
        if not isinstance(other, Evaluation):
            raise TypeError(f"other: an Evaluation is wanted, got {type(other).__name__}")
        if self.costs.shape != other.costs.shape:
            raise ValueError(
                f"other: {other.costs.shape} trials, wanted {self.costs.shape} under the same noise"
            )
        own, theirs = self.key, other.key
        if is_concrete(own, theirs) and not np.array_equal(np.asarray(own), np.asarray(theirs)):
            raise ValueError("other: its trials had another key, and so another noise")
        difference = self.costs - other.costs
        return jnp.mean(difference, axis=-1), _error(difference)

    def __str__(self) -> str:
        if not is_concrete(self.costs) or self.costs.ndim > 1:
            return eqx.tree_pformat(self)
        lines = [
            f"Evaluation of {self.costs.size} trials",
            f"  cost        {float(self.cost):.6g} +- {float(self.cost_error):.2g}",
        ]
        if self.hands is not None:
            sd = np.sqrt(np.diag(np.atleast_2d(self.hand_cov)))
            lines.append("  hand's SD   " + ", ".join(f"{1e3 * s:.3g}" for s in sd) + " mm")
        if self.misses is not None:
            lines.append(f"  misses      {1e3 * float(jnp.median(self.misses)):.3g} mm (median)")
        if self.collided is not None:
            lines.append(f"  collisions  {100 * float(self.collisions):.3g} %")
        lost = int((~np.isfinite(np.asarray(self.costs_without_obstacles))).sum())
        if lost:
            lines.append(f"  NOT finite  {lost} of {self.costs.size} trials")
        return "\n".join(lines)


def _error(values: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.std(values, ddof=1, axis=-1) / jnp.sqrt(values.shape[-1])


def _cov(values: Float[Array, "*batch n m"]) -> Float[Array, "*batch m m"]:
    around = values - jnp.mean(values, axis=-2, keepdims=True)
    return around.mT @ around / (values.shape[-2] - 1)


def _wanted(values: Array | None, what: str) -> Array:
    if values is None:
        raise ValueError(f"this problem has no {what}")
    return values


def evaluate(
    problem: Problem,
    controllers: AbstractController | Mapping[str, AbstractController],
    x0: ArrayLike,
    *,
    key: Array,
    trials: int = 1000,
    plant: AbstractPlant | None = None,
    noise: AbstractNoise | None = None,
) -> Any:
    """Run controllers through many noisy trials, and tell what they cost and how they end.

    Trial i has the key `jax.random.fold_in(key, i)`, for every controller: they meet the same noise
    (common random numbers), and the result does not depend on the number of devices. Trajectories
    are not kept, so that memory does not grow with their length.

    Arguments:
        problem, x0, plant, noise: as in `simulate`.
        controllers: one controller, such as `solution.policy`, or several by name.
        key: a `jax.random.key`.
        trials: how many, at least 2; static.

    Returns: an `Evaluation`, or a dictionary of them with the controllers' names.

    Raises: as `simulate` does; ValueError for fewer than two trials.
    """
    trials = check_integer("trials", trials, 2)
    check_key(key)
    if isinstance(controllers, Mapping):
        if not controllers:
            raise ValueError("controllers: at least one is wanted, got none")
        several = controllers
    else:
        several = {"": controllers}
    found = {
        name: _evaluate(problem, controller, x0, key, trials, plant, noise)
        for name, controller in several.items()
    }
    return found if isinstance(controllers, Mapping) else found[""]


def _evaluate(problem, controller, x0, key, trials, plant, noise) -> Evaluation:
    # Eagerly once: what does not fit is refused here, where values can be known.
    jax.eval_shape(lambda: simulate(problem, controller, x0, key=key, plant=plant, noise=noise))
    job = _Trials(problem, controller, jnp.asarray(x0), key, plant, noise)
    concrete = is_concrete(*jax.tree.leaves(eqx.filter(job, eqx.is_array)))
    devices = tuple(jax.devices()[:trials]) if concrete else tuple(jax.devices()[:1])
    found = _run(job, trials, devices)
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return eqx.tree_at(
        lambda e: e.key, found, jax.random.key_data(key) if typed else key,
        is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip


class _Trials(eqx.Module):
    """What is run: the arguments of `evaluate`."""

    problem: Problem
    controller: AbstractController
    x0: Array
    key: Array
    plant: AbstractPlant | None
    noise: AbstractNoise | None

    def run(self, i) -> Evaluation:
        """Return the evaluation of one trial."""
        problem, mover = self.problem, self.problem.plant if self.plant is None else self.plant
        trial = simulate(
            problem, self.controller, self.x0,
            key=jax.random.fold_in(self.key, i), plant=self.plant, noise=self.noise,
        )  # fmt: skip
        costs = parts(problem.cost)
        marks = [getattr(part, "marks", None) for part in costs]
        clear = tuple(
            c for c, m in zip(costs, marks, strict=True) if m is None or not len(m.obstacles)
        )
        targets = [m.targets for m in marks if m is not None and len(m.targets)]
        discs = [m.obstacles for m in marks if m is not None and len(m.obstacles)]
        # The whole path where obstacles may be met, else its end alone.
        seen = trial.xs if discs else trial.xs[-1:]
        hands = jax.vmap(mover.hand)(seen) if isinstance(mover, AbstractHand) else None
        without = trial.cost
        if discs:
            rest = eqx.tree_at(lambda p: (p.cost, p.plant), problem, (SumCost(clear), mover))
            without = rest.total_cost(trial.xs, trial.us)
        return Evaluation(
            costs=trial.cost,
            ends=trial.xs[-1],
            hands=None if hands is None else hands[-1],
            misses=_miss(hands, targets),
            collided=_collides(hands, discs),
            costs_without_obstacles=without,
        )


def _miss(hands, targets) -> Array | None:
    if hands is None or not targets:
        return None
    return jnp.min(jnp.linalg.norm(jnp.concatenate(targets) - hands[-1], axis=1))


def _collides(hands, discs) -> Array | None:
    """Tell whether the straight pieces of a path (T+1, dim) come nearer than a disc's radius."""
    if hands is None or not discs:
        return None
    discs = jnp.concatenate(discs)
    centres, radii = discs[:, :-1], discs[:, -1]
    start, along = hands[:-1, None], (hands[1:] - hands[:-1])[:, None]
    square = jnp.sum(along**2, axis=-1)
    fraction = jnp.sum((centres - start) * along, axis=-1) / jnp.where(square > 0, square, 1.0)
    nearest = start + jnp.clip(fraction, 0.0, 1.0)[..., None] * along
    return (jnp.linalg.norm(nearest - centres, axis=-1) <= radii).any()


@jit
def _run(job: _Trials, trials: int, devices) -> Evaluation:
    """Share trials evenly among devices; the last one is repeated to fill the last share."""
    if len(devices) == 1:
        return jax.lax.map(job.run, jnp.arange(trials), batch_size=min(CHUNK, trials))
    n = len(devices)
    each = -(-trials // n)
    index = jnp.minimum(jnp.arange(n * each), trials - 1)
    arrays, static = eqx.partition(job, eqx.is_array)

    def share(index, arrays):
        own = eqx.combine(arrays, static)
        return jax.lax.map(own.run, index, batch_size=min(CHUNK, each))

    spec = PartitionSpec("trials")
    mapped = jax.shard_map(
        share, mesh=Mesh(np.array(devices), ("trials",)), in_specs=(spec, PartitionSpec()),
        out_specs=spec, check_vma=False,
    )  # fmt: skip
    return jax.tree.map(lambda leaf: leaf[:trials], mapped(index, arrays))
