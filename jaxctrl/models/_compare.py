"""One task under several models, side by side."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike
from matplotlib.figure import Figure

from .. import analysis, plot
from .._checks import is_concrete
from .._jit import jit
from .._problem import Problem
from .._solution import Solution
from .._solve import solve
from ..solvers import DDP, AbstractSolver
from ..tasks import Marks
from ._models import AbstractModel, marks


@dataclass(frozen=True, repr=False)
class Comparison:
    """Hold one task as several models have it; printed, a table.

    The end error is the distance of the last position from the target, or from the end of a tracked
    path; the deviation is that from the straight line, or, of a tracked path, the root mean square
    distance from where the hand should be.

    Arguments:
        task: the task. models: what was compared; names: one name for each.
        problems, solutions: the models' problems and their solutions, in the order of `models`.
        ts: times [s], (T+1,). hands: positions [m], (m, T+1, 2). velocities: [m/s], the same shape.
    """

    task: Problem
    models: tuple[AbstractModel, ...]
    names: tuple[str, ...]
    problems: tuple[Problem, ...]
    solutions: tuple[Solution, ...]
    ts: np.ndarray
    hands: np.ndarray
    velocities: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether every solve converged."""
        return all(bool(solution.status.ok) for solution in self.solutions)

    @property
    def speeds(self) -> np.ndarray:
        """The hand's speeds [m/s], (m, T+1)."""
        return np.linalg.norm(self.velocities, axis=-1)

    @property
    def distances(self) -> np.ndarray:
        """The paths' root mean square distances [m], (m, m): `analysis.path_distance`."""
        return np.array([[analysis.path_distance(a, b) for a in self.hands] for b in self.hands])

    def __str__(self) -> str:
        head = (
            "model",
            "status",
            "iterations",
            "peak speed",
            "at",
            "peaks",
            "deviation",
            "end error",
        )
        rows = [head, ("", "", "", "m/s", "s", "", "mm", "mm")]
        for name, solution, hand, speed in zip(
            self.names, self.solutions, self.hands, self.speeds, strict=True
        ):
            found = analysis.speed_peaks(self.ts, speed)
            at = found.peak_times[found.peak_speeds.argmax()] if len(found.peak_times) else np.nan
            aside, error = _errors(self.task, hand)
            rows.append(
                (
                    name,
                    solution.status.name,
                    f"{int(solution.num_steps)}",
                    f"{speed.max():.3f}",
                    f"{at:.3f}",
                    f"{len(found.peak_times)}",
                    "-" if aside is None else f"{1e3 * aside:.2f}",
                    "-" if error is None else f"{1e3 * error:.3f}",
                )
            )
        widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
        lines = []
        for row in rows:
            cells = [row[0].ljust(widths[0]), row[1].ljust(widths[1])]
            cells += [cell.rjust(width) for cell, width in zip(row[2:], widths[2:], strict=True)]
            lines.append("  ".join(cells).rstrip())
        bad = [
            f"{name}: {solution.status.message}"
            for name, solution in zip(self.names, self.solutions, strict=True)
            if not bool(solution.status.ok)
        ]
        return "\n".join(lines + bad)

    __repr__ = __str__

    def figure(self) -> Figure:
        """Draw the paths, with targets, via-points and obstacles, beside the speed profiles."""
        figure, axes = plot.panels(1, 2, size=(7.5, 3.0))
        shown = _marks(self.task)
        plot.hand_paths(
            list(self.hands),
            shown.targets,
            via=shown.points if len(shown.points) else None,
            obstacles=shown.obstacles if len(shown.obstacles) else None,
            labels=self.names,
            ax=axes[0, 0],
        )
        plot.speed_profiles(self.ts, list(self.speeds), labels=self.names, ax=axes[0, 1])
        if (legend := axes[0, 1].get_legend()) is not None:
            legend.remove()  # the one beside the paths is for both
        return figure


def _errors(task: Problem, hand: np.ndarray) -> tuple[float | None, float | None]:
    """Return a path's deviation and its error at the end [m]; None where the task has none."""
    shown = _marks(task)
    targets = shown.targets
    if shown.path is not None:
        s, at = np.linspace(0, 1, len(hand)), np.linspace(0, 1, len(shown.path))
        wanted = np.stack([np.interp(s, at, column) for column in shown.path.T], axis=1)
        squares = np.sum((hand - wanted) ** 2, axis=1)
        return float(np.sqrt(np.mean(squares))), float(np.sqrt(squares[-1]))
    straight = np.linalg.norm(hand[-1] - hand[0]) > 1e-6
    aside = abs(float(analysis.deviation(hand))) if straight else None
    error = float(np.linalg.norm(hand[-1] - targets[-1])) if len(targets) else None
    return aside, error


def _marks(task: Problem) -> Marks:
    """Return what all parts of a task's cost show, as NumPy arrays; of several paths the first."""
    shown = (Marks(), *marks(task))
    points = [
        np.concatenate([np.reshape(one[i], (-1, size)) for one in shown])
        for i, size in enumerate((2, 2, 3))
    ]
    paths = [np.asarray(one.path) for one in shown if one.path is not None]
    return Marks(points[0], points[1], points[2], paths[0] if paths else None)


def compare(
    models: Sequence[AbstractModel],
    task: Problem,
    x0: ArrayLike,
    solver: AbstractSolver | None = None,
    *,
    max_steps: int = 500,
) -> Comparison:
    """Solve one task as several models have it.

    Arguments:
        models: such as `jc.models.MinimumJerk()`.
        task: a movement made by `jc.tasks`, with costs of your own or not.
        x0: the starting state of the task's plant, shape (nx,); each model makes its own of it.
        solver, max_steps: as in `jc.solve`; `DDP()` by default, whose convergence does not slow
            down where the costs of torque changes make an ILQR's do so.

    Returns: `Comparison`: print it, draw its `figure()`, look at `ok`. It is for known values, not
    under jit. The first call compiles: half a minute or more with muscles.

    Raises TypeError or ValueError, naming the argument, for what does not fit, such as a posture
    for a model of the hand alone.
    """
    if isinstance(models, Problem):
        raise TypeError("models: a list of models is wanted first, then the task, got a task")
    if not is_concrete(x0, *jax.tree.leaves(eqx.filter(task, eqx.is_array))):
        raise ValueError(
            "task, x0: known values are wanted, got traced ones; under jit, vmap or grad use "
            "jc.solve(model.problem(task), solver, model.start(task, x0))"
        )
    single = isinstance(models, AbstractModel | type)
    given: tuple[AbstractModel, ...] = (models,) if single else tuple(models)  # pyright: ignore
    for model in given:
        if not isinstance(model, AbstractModel):
            hint = f"; write {model.__name__}()" if isinstance(model, type) else ""
            raise TypeError(f"models: a model is wanted, got {model!r}{hint}")
    if not given:
        raise ValueError("models: at least one is wanted, got none")
    problems = tuple(model.problem(task) for model in given)
    starts = [model.start(task, x0) for model in given]
    solutions = tuple(
        solve(problem, DDP() if solver is None else solver, start, max_steps=max_steps)
        for problem, start in zip(problems, starts, strict=True)
    )
    motions = [hand_motion(p, s.xs) for p, s in zip(problems, solutions, strict=True)]
    hands, velocities = (np.stack([np.asarray(m[i]) for m in motions]) for i in range(2))
    return Comparison(
        task, given, _names(given), problems, solutions, np.asarray(task.ts), hands, velocities
    )


def _names(models: Sequence[AbstractModel]) -> tuple[str, ...]:
    """Return the models' names, numbered where one occurs twice."""
    names = [model.name for model in models]
    return tuple(
        name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    )


@jit
def hand_motion(problem: Problem, xs) -> tuple[jax.Array, jax.Array]:
    """Return positions [m] and velocities [m/s] of the hand, each (T+1, 2), for xs (T+1, nx)."""
    plant = problem.plant
    return jax.vmap(plant.hand)(xs), jax.vmap(plant.hand_velocity)(xs)  # pyright: ignore
