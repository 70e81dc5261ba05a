"""Movements of an arm planned under several models, each from several starts.

Optima are local: each movement is solved from the nominal controls, from those that follow the
path of least jerk, from random constant excitations, and from what another model found. The hand
does not tell an elbow that bends the wrong way: through via-points, where it would, the elbow is
limited to the range of the model's muscles, 0 to pi, softly, and kept is the cheapest solution
that stays within a hundredth of a radian of it.
"""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from ._result import Claim, named

MISS = 0.005
"""What counts as missing a via-point [m]; our choice."""

AMPLITUDE = 0.3
"""Random starts are constant excitations from U[0, AMPLITUDE]; our choice."""

SLIGHT = (0.005, 0.15)
"""What counts as slightly curved, deviation over length: the median above the first, and 95 % of
the movements below the second; our choice."""

MODELS = {"torque change": jc.models.MinimumTorqueChange, "energy": jc.models.MinimumEnergy}


def check_active_state(word: str) -> None:
    """Raise ValueError for a word that is none of the muscles' active states."""
    jc.plants.MuscleArm(active_state=word)  # pyright: ignore[reportArgumentType]


def check_positive(**numbers: float) -> None:
    """Raise ValueError naming a setting that is not a finite number above zero."""
    for name, number in numbers.items():
        if not 0 < number < float("inf"):
            raise ValueError(f"{name}: a finite number above 0 is wanted, got {number}")


@dataclass(frozen=True)
class MovementConfig:
    """Settings of a planned movement: duration [s] and number of time steps.

    `restarts` random starts of each movement, besides those that are always tried; at most
    `max_steps` iterations from each; the `seed` of the random starts; the muscles' `active_state`,
    "linear", "brown" or "brown-fixed". A figure adds what else it needs.
    """

    duration: float = 0.5
    num_steps: int = 50
    restarts: int = 2
    max_steps: int = 600
    seed: int = 0
    active_state: str = "linear"

    def __post_init__(self):
        check_active_state(self.active_state)

    @property
    def arm(self) -> jc.plants.MuscleArm:
        """The arm moved by muscles."""
        return jc.plants.MuscleArm(active_state=self.active_state)  # pyright: ignore[reportArgumentType]


class Movement(NamedTuple):
    """What to plan: start, target [m], each (2,), and a via-point [m] (2,) with its time [s]."""

    start: np.ndarray
    target: np.ndarray
    point: np.ndarray | None = None
    time: float | None = None

    @property
    def via(self) -> dict[str, np.ndarray]:
        """The via-points (m, 2) and their times (m,), as tasks and `minimum_jerk` take them."""
        if self.point is None or self.time is None:
            return {}
        return {"points": self.point[None], "times": np.array([self.time])}


class Planned(NamedTuple):
    """A movement as one model has it.

    Fields: hand [m] and velocity [m/s], each (T+1, 2); us (T, nu); cost; iterations; how many
    starts converged with a sound elbow, and how many there were; their highest over lowest cost.
    """

    hand: np.ndarray
    velocity: np.ndarray
    us: np.ndarray
    cost: float
    iterations: int
    sound: int
    starts: int
    spread: float


def task_of(
    arm: jc.plants.MuscleArm | jc.plants.TorqueArm, movement: Movement, config: MovementConfig
) -> jc.Problem:
    """Return the reach, or the movement through a via-point."""
    steps = {"duration": config.duration, "num_steps": config.num_steps}
    if not movement.via:
        return jc.tasks.reach(arm, movement.target, **steps)
    task = jc.tasks.via(arm, movement.target, **movement.via, **steps)
    return jc.tasks.limit_joints(task, np.array([-np.inf, 0.0]), np.array([np.inf, np.pi]))


def plan(
    arm: jc.plants.MuscleArm | jc.plants.TorqueArm,
    movements: Sequence[Movement],
    config: MovementConfig,
) -> dict[str, list[Planned]]:
    """Plan movements from rest under minimum torque change and minimum energy."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        guess = functools.partial(_first_guesses, arm, config=config)
        starts = _mapped(pool, guess, movements)
        found: dict[str, list[Planned]] = {}
        for name, kind in MODELS.items():
            plan_one = functools.partial(_plan_one, arm, kind(), config)
            found[name] = _mapped(pool, plan_one, movements, starts)
            if isinstance(arm, jc.plants.MuscleArm):
                starts = [[*s, p.us] for s, p in zip(starts, found[name], strict=True)]
    return found


def _mapped(pool: ThreadPoolExecutor, call: Callable[..., Any], *items: Sequence[Any]) -> list[Any]:
    """Call a function for each item in threads, the first alone: it compiles for all of them."""
    first, *others = zip(*items, strict=True)
    return [call(*first), *pool.map(lambda each: call(*each), others)]


def _first_guesses(arm, movement: Movement, config: MovementConfig) -> list[np.ndarray | None]:
    """Return the controls from which to solve; None for the nominal ones, which do for torques."""
    if isinstance(arm, jc.plants.TorqueArm):
        return [None]
    ts = np.linspace(0, config.duration, config.num_steps + 1)
    path = np.asarray(least_jerk(movement, ts).position)
    far = np.linalg.norm(path, axis=1, keepdims=True) / (0.99 * float(arm.longest_reach))
    path = path / np.maximum(far, 1.0)  # least jerk knows no arm, and may leave its reach
    follow = jc.tasks.track(
        arm, path, config.duration, num_steps=config.num_steps, path_weight=100.0, effort=1e-5
    )
    followed = jc.solve(follow, jc.ILQR(), _at_rest(arm, movement), max_steps=60)
    rng = np.random.default_rng(config.seed)
    levels = AMPLITUDE * rng.random((config.restarts, arm.nu))
    constant = [np.tile(level, (config.num_steps, 1)) for level in levels]
    return [None, np.asarray(followed.us), *constant]


def _at_rest(arm: jc.plants.MuscleArm | jc.plants.TorqueArm, movement: Movement) -> jax.Array:
    q = arm.inverse_kinematics(jnp.asarray(movement.start))
    return arm.at_rest(q[0], q[1])


def _plan_one(
    arm, model: jc.models.AbstractModel, config: MovementConfig, movement: Movement, guesses
) -> Planned:
    """Solve from every guess, and keep the cheapest sound solution, or the cheapest at all."""
    task = task_of(arm, movement, config)
    problem, x0 = model.problem(task), model.start(task, _at_rest(arm, movement))
    tried = [jc.solve(problem, jc.DDP(), x0, us, max_steps=config.max_steps) for us in guesses]
    sound = [solution for solution in tried if bool(solution.status.ok) and _sound(solution)]
    costs = [float(solution.cost) for solution in sound or tried]
    kept = (sound or tried)[int(np.argmin(costs))]
    body: Any = problem.plant
    return Planned(
        np.asarray(jax.vmap(body.hand)(kept.xs)),
        np.asarray(jax.vmap(body.hand_velocity)(kept.xs)),
        np.asarray(kept.us),
        min(costs),
        int(kept.num_steps),
        len(sound),
        len(tried),
        max(costs) / min(costs),
    )


def _sound(solution: jc.Solution) -> bool:
    """Tell whether the elbow stays within 0 and pi, to 0.01 rad."""
    elbow = np.asarray(solution.xs[:, 1])
    return bool((elbow > -0.01).all() and (elbow < np.pi + 0.01).all())


def dataset(
    planned: dict[str, list[Planned]],
    labels: Sequence[str],
    movements: Sequence[Movement],
    config: MovementConfig,
) -> xarray.Dataset:
    """Label what was planned: hand, velocity, speed, cost, iterations, by model and movement."""
    ts = np.linspace(0, config.duration, config.num_steps + 1)
    over, along = ("model", "movement"), ("model", "movement", "time")

    def gather(field: str) -> np.ndarray:
        return np.array([[getattr(one, field) for one in found] for found in planned.values()])

    hand, velocity = gather("hand"), gather("velocity")
    data = {
        "hand": ((*along, "axis"), hand, named("hand position", "m")),
        "speed": (along, np.linalg.norm(velocity, axis=-1), named("hand speed", "m/s")),
        "velocity": ((*along, "axis"), velocity, named("hand velocity", "m/s")),
        "cost": (over, gather("cost"), named("cost", "1")),
        "iterations": (over, gather("iterations"), named("iterations from the best start", "1")),
        "sound": (over, gather("sound"), named("starts that gave a sound optimum", "1")),
        "spread": (over, gather("spread"), named("highest over lowest cost of these", "1")),
        "target": (
            ("movement", "axis"),
            np.array([m.target for m in movements]),
            named("target", "m"),
        ),
    }
    if movements[0].point is not None:
        points = np.array([m.point for m in movements])
        times = np.array([m.time for m in movements])
        data["point"] = (("movement", "axis"), points, named("via-point", "m"))
        data["passing"] = (("movement",), times, named("passing time", "s"))
        miss = [
            [np.linalg.norm([np.interp(t, ts, c) for c in one.hand.T] - p) for one, t, p in trio]
            for trio in (zip(found, times, points, strict=True) for found in planned.values())
        ]
        data["miss"] = (over, np.array(miss), named("distance from the via-point", "m"))
    coords = {
        "model": ("model", list(planned), {"long_name": "model"}),
        "movement": ("movement", list(labels), {"long_name": "movement"}),
        "time": ("time", ts, named("time", "s")),
        "axis": ("axis", ["x", "y"], {"long_name": "axis"}),
    }
    return xarray.Dataset(data, coords=coords)


def failures(planned: dict[str, list[Planned]], labels: Sequence[str]) -> str:
    """Say which movements were not solved, or nothing."""
    return "; ".join(
        f"{name}, {label}: none of {one.starts} starts converged with a sound elbow"
        for name, found in planned.items()
        for label, one in zip(labels, found, strict=True)
        if not one.sound
    )


def least_jerk(movement: Movement, ts: np.ndarray) -> jc.models.Path:
    """Return the path of least jerk at times ts (n,) [s], from 0 to the duration."""
    return jc.models.minimum_jerk(movement.start, movement.target, ts[-1], ts, **movement.via)


def milliseconds(time: float) -> str:
    """Write a time [s] in milliseconds, or that there is none."""
    return f"{1e3 * time:.0f} ms" if np.isfinite(time) else "none"


def slightly_curved(bends: np.ndarray) -> tuple[bool, str]:
    """Tell whether paths are slightly curved by `SLIGHT`, and say by how much they are.

    Arguments:
        bends: deviation from the straight line over its length, (n,), signed or not.
    """
    sizes = np.abs(bends)
    middle, high = float(np.median(sizes)), float(np.percentile(sizes, 95))
    text = (
        f"median {100 * middle:.1f} % of the length, 95 % below {100 * high:.1f} %, largest "
        f"{100 * sizes.max():.1f} %"
    )
    return middle > SLIGHT[0] and high < SLIGHT[1], text


def passed(data: xarray.Dataset, model: str, source: str) -> Claim:
    """Judge whether the via-points are passed."""
    miss = 1e3 * data.miss.sel(model=model).values
    near = bool((miss < 1e3 * MISS).all())
    listed = ", ".join(
        f"{label} {value:.1f}" for label, value in zip(data.movement.values, miss, strict=True)
    )
    return Claim(
        f"The via-points are passed ({model})",
        source,
        "within 5 mm",
        f"missed by {listed} mm",
        near,
        ""
        if near
        else "from rest and without activation it is too soon for the muscles, at their price",
    )


def profiles(data: xarray.Dataset, model: str) -> list[jc.analysis.SpeedProfile]:
    """Return the peaks and valleys of each movement's speed."""
    ts = data.time.values
    return [jc.analysis.speed_peaks(ts, speed) for speed in data.speed.sel(model=model).values]


class Valley(NamedTuple):
    """The deepest valley of a movement's speed, and the peak of curvature that is nearest in time.

    Fields: time of the valley [s]; depth as a share of the lower neighbouring peak; time [s] and
    height [1/m] of the peak of curvature. NaN where there is none, and depth 0 without a valley.
    """

    time: float
    depth: float
    bend: float
    height: float


def valleys(data: xarray.Dataset, model: str) -> list[Valley]:
    """Return the deepest valley of each movement's speed under a model."""
    part, ts, found = data.sel(model=model), data.time.values, []
    curvatures = jc.analysis.curvature(part.hand, ts, velocities=part.velocity)
    for speed, curvature in zip(part.speed.values, curvatures, strict=True):
        profile = jc.analysis.speed_peaks(ts, speed)
        bends = jc.analysis.curvature_peaks(ts, curvature, speed)
        if not len(profile.valley_depth):
            found.append(Valley(np.nan, 0.0, np.nan, np.nan))
            continue
        deepest = int(np.argmax(profile.valley_depth))
        time, bend, height = float(profile.valley_times[deepest]), np.nan, np.nan
        if len(bends.times):
            nearest = int(np.argmin(np.abs(bends.times - time)))
            bend, height = float(bends.times[nearest]), float(bends.heights[nearest])
        found.append(Valley(time, float(profile.valley_depth[deepest]), bend, height))
    return found


def depths(found: Sequence[Valley]) -> str:
    """Write how deep valleys are, as shares of the lower neighbouring peak."""
    return "valleys " + ", ".join(f"{100 * valley.depth:.0f}" for valley in found) + " % deep"


def at_the_bend(statement: str, source: str, found: Sequence[Valley]) -> Claim:
    """Judge whether valleys of the speed coincide with peaks of the curvature."""
    gaps = np.array([abs(v.time - v.bend) for v in found if np.isfinite(v.time)])
    holds = gaps.size > 0 and bool((gaps <= 0.04).all())  # NaN, a valley without a bend, does not
    apart = f"at most {1e3 * gaps.max():.0f} ms apart; " if gaps.size else ""
    return Claim(
        statement,
        source,
        "within 40 ms of each other, where the speed has a valley (our reading)",
        f"{apart}{gaps.size} of {len(found)} movements have a valley, at "
        + ", ".join(milliseconds(valley.time) for valley in found),
        holds,
        "" if holds else "the bend comes elsewhere" if gaps.size else "no movement has two peaks",
    )


def draw(data: xarray.Dataset, numbers: dict[str, str]) -> Figure:
    """Draw paths and speeds through via-points, one row for each model, titled by its figure."""
    fig, axes = jc.plot.panels(len(numbers), 2, size=(7.5, 5.6))
    labels = [str(label) for label in data.movement.values]
    for row, (model, number) in zip(axes, numbers.items(), strict=True):
        part = data.sel(model=model)
        jc.plot.hand_paths(
            list(part.hand.values),
            data.target.values,
            via=data.point.values,
            labels=labels,
            ax=row[0],
        )
        jc.plot.speed_profiles(data.time, list(part.speed.values), labels=labels, ax=row[1])
        row[1].get_legend().remove()
        _name_points(row[0], part)
        for time in np.unique(data.passing.values):
            row[1].axvline(time, color="0.6", linewidth=0.7, zorder=0)
        with jc.plot.style():
            row[0].set_title(f"{number}  minimum {model}", loc="left")
            row[1].set_title("grey: when the via-point is passed", loc="left", color="0.4")
    top = max(ax.get_ylim()[1] for ax in axes[:, 1])
    for ax in axes[:, 1]:
        ax.set_ylim(0, top)
    return fig


def _name_points(ax: Axes, part: xarray.Dataset) -> None:
    """Write each via-point's name beside it, and mark where the hand was instead when it missed."""
    with jc.plot.style():
        names = [str(label) for label in part.movement.values]
        scale = 100 if "[cm]" in ax.get_xlabel() else 1
        points, ts = scale * part.point.values, part.time.values
        if len(np.unique(points, axis=0)) == len(points):
            for name, point in zip(names, points, strict=True):
                aside = -11 if point[1] < scale * part.hand.values[0, 0, 1] else 5
                ax.annotate(name, point, xytext=(3, aside), textcoords="offset points", fontsize=7)
        for i in np.flatnonzero(part.miss.values > MISS):
            passing = float(part.passing.values[i])
            x, y = (np.interp(passing, ts, column) for column in scale * part.hand.values[i].T)
            ax.plot(x, y, "s", color=f"C{i}", markerfacecolor="none", markersize=6)
            text = f"{1e3 * passing:.0f} ms: off by {1e3 * part.miss.values[i]:.0f} mm"
            ax.annotate(text, (x, y), xytext=(-20, -26), textcoords="offset points", fontsize=7)
