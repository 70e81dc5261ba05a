"""How much the path of a 10 cm reach curves, over the workspace in front of the body.

"Slightly curved hand path does occur, depending on the area of the workspace" (Li 2006, section
3.4). Reaches in four directions start from a grid of positions, under minimum torque change and
under minimum energy of one arm with six muscles, the arm of Li's figures 3.4 and 3.5. Reaches that
leave the area in which neither the arm is nearly straight nor the elbow nearly closed are left out.
Grid, distance and duration are our choice.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

import jaxctrl as jc

from ._planned import check_active_state, check_positive, slightly_curved
from ._result import Claim, Result, named

MODELS = ("torque change", "energy")
DIRECTIONS = {0: "right", 90: "forward", 180: "left", 270: "backward"}
"""Directions of the reaches [degree from +x]: transverse and radial by turns."""

AREA = ((-0.35, 0.35), (0.2, 0.55))
"""Ranges of x and y [m] from which reaches start; the shoulder is at the origin."""

NEAREST, FARTHEST = 0.15, 0.58
"""Distances [m] of the hand from the shoulder: elbow at 149 and at 45 degrees."""

LEVELS = (0.05, 0.02, 0.1)
"""Constant excitations from which each reach is solved; the cheapest result is kept."""

AGREE = (0.01, 0.02)
"""How far two starts may differ in cost, as a fraction, and in curvature, to confirm each other."""

NEAR = (int(jc.Reason.NEARLY_CONVERGED), int(jc.Reason.STALLED))
"""How a solve may end when another confirms it: the muscles' curves have kinks, in which the
gradient does not vanish."""

DARKEST = 15.0
"""Where the colours of the map end at the latest [% of the length]: what counts as slight."""


@dataclass(frozen=True)
class Config:
    """Settings: columns and rows of the grid of starts.

    distance [m], duration [s] and number of time steps of each reach; `effort`, the weight of
    minimum energy; the muscles' active state, "linear", "brown" or "brown-fixed".
    """

    columns: int = 15
    rows: int = 9
    distance: float = 0.1
    duration: float = 0.5
    num_steps: int = 50
    effort: float = 1e-4
    active_state: str = "linear"

    def __post_init__(self):
        check_active_state(self.active_state)
        check_positive(distance=self.distance)

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with a coarser grid and time step."""
        return cls(columns=3, rows=2, num_steps=25)

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """The positions x (columns,) and y (rows,) [m] from which reaches start."""
        return np.linspace(*AREA[0], self.columns), np.linspace(*AREA[1], self.rows)


def _starts(config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column, row and direction (n, 3) of all reaches, their starts and targets (n, 2)."""
    x, y = config.grid
    where, starts, targets = [], [], []
    for row in range(config.rows):
        for column in range(config.columns):
            start = np.array([x[column], y[row]])
            for k, degrees in enumerate(DIRECTIONS):
                angle = np.radians(degrees)
                target = start + config.distance * np.array([np.cos(angle), np.sin(angle)])
                line = start + np.linspace(0, 1, 21)[:, None] * (target - start)
                away = np.linalg.norm(line, axis=1)
                if away.min() >= NEAREST and away.max() <= FARTHEST:
                    where.append((column, row, k))
                    starts.append(start)
                    targets.append(target)
    return np.array(where), np.array(starts), np.array(targets)


def _solve(model: jc.models.AbstractModel, starts, targets, config: Config):
    """Solve all reaches in one batch from each level: hands (levels, n, T+1, 2), costs (levels, n).

    What is no solution costs infinity.
    """
    arm = jc.plants.MuscleArm(active_state=config.active_state)  # pyright: ignore[reportArgumentType]

    def task(target):
        return jc.tasks.reach(arm, target, config.duration, num_steps=config.num_steps)

    at = [arm.at_rest(*arm.inverse_kinematics(start)) for start in starts]
    at = jnp.stack([model.start(task(targets[0]), x0) for x0 in at])
    problems = jax.vmap(lambda target: model.problem(task(target)))(jnp.array(targets))
    hands, costs = [], []
    for level in LEVELS:
        controls = jnp.full((len(targets), config.num_steps, arm.nu), level)
        solved = jc.solve_batch(problems, jc.ILQR(), at, controls)
        usable = np.asarray(solved.status.ok) | np.isin(np.asarray(solved.status.code), NEAR)
        hands.append(np.asarray(jax.vmap(jax.vmap(arm.hand))(solved.xs)))
        costs.append(np.where(usable, np.asarray(solved.cost), np.inf))
    return np.array(hands), np.array(costs)


def _kept(hands: np.ndarray, costs: np.ndarray, targets: np.ndarray, config: Config):
    """Keep the cheapest of the solutions from several starts, (levels, n, ...).

    A reach counts as solved where another start agrees with it.
    """
    strays = jc.analysis.deviation(hands) / config.distance
    lane, cheapest = np.arange(len(targets)), costs.argmin(axis=0)
    hand, stray, least = hands[cheapest, lane], strays[cheapest, lane], costs[cheapest, lane]
    alike = (costs <= (1 + AGREE[0]) * least) & (np.abs(strays - stray) <= AGREE[1])
    return {
        "hand": hand,
        "curvature": stray,
        "error": np.linalg.norm(hand[:, -1] - targets, axis=1),
        "solved": np.isfinite(least) & (alike.sum(axis=0) >= 2),
        "first": np.isfinite(least) & alike[0],
    }


def run(config: Config) -> Result:
    """Reach from every start with both models; arrays lead with the model."""
    where, starts, targets = _starts(config)
    models = (jc.models.MinimumTorqueChange(), jc.models.MinimumEnergy(config.effort))  # pyright: ignore[reportCallIssue]
    parts = []
    for model in models:
        parts.append(_kept(*_solve(model, starts, targets, config), targets, config))
    found = {key: np.stack([part[key] for part in parts]) for key in parts[0]}
    each, ts = ("model", "reach"), np.linspace(0, config.duration, config.num_steps + 1)
    data = xarray.Dataset(
        {
            "start": (("reach", "axis"), starts, named("start of the hand", "m")),
            "target": (("reach", "axis"), targets, named("target", "m")),
            "cell": (("reach", "index"), where, named("column, row and direction", "1")),
            "hand": ((*each, "time", "axis"), found["hand"], named("hand position", "m")),
            "curvature": (
                each,
                found["curvature"],
                named("deviation to the left of the straight line, over its length", "1"),
            ),
            "error": (each, found["error"], named("distance from the target at the end", "m")),
            "solved": (each, found["solved"], named("whether it is solved, and confirmed", "1")),
            "first": (each, found["first"], named("whether the first start alone does", "1")),
        },
        coords={
            "model": ("model", list(MODELS), {"long_name": "model"}),
            "time": ("time", ts, named("time", "s")),
            "axis": ("axis", ["x", "y"], {"long_name": "axis"}),
        },
    )
    failed = [
        f"minimum {name}: only {100 * share:.0f} % of the reaches are solved"
        for name, share in zip(MODELS, found["solved"].mean(axis=1), strict=True)
        if share < 0.5
    ]
    return Result(data, config, "; ".join(failed))


def _curvatures(result: Result, name: str) -> np.ndarray:
    """Return a model's curvatures [% of the length], NaN where a reach is not solved."""
    data = result.data.sel(model=name)
    return np.where(data.solved.values, 100 * data.curvature.values, np.nan)


def _maps(result: Result, name: str) -> np.ndarray:
    """Return a model's curvatures (directions, ny, nx) [%], NaN where there is none."""
    values = np.full((len(DIRECTIONS), result.config.rows, result.config.columns), np.nan)
    column, row, k = result.data.cell.values.T
    values[k, row, column] = _curvatures(result, name)
    return values


def figure(result: Result) -> Figure:
    """Map the signed curvature of each direction, and its mean magnitude; one row for a model.

    All signed maps have one scale, and so have both maps of the magnitude.
    """
    fig, axes = jc.plot.panels(len(MODELS), len(DIRECTIONS) + 1, size=(12.0, 4.2))
    signed = [_maps(result, name) for name in MODELS]
    counted = [np.isfinite(maps).sum(axis=0) for maps in signed]
    sizes = [
        np.nansum(np.abs(maps), axis=0) / np.where(count > 0, count, np.nan)
        for maps, count in zip(signed, counted, strict=True)
    ]
    ends = [min(float(np.nanmax(np.abs(part))), DARKEST) for part in (signed, sizes)]
    for row, name in enumerate(MODELS):
        for column, word in enumerate(DIRECTIONS.values()):
            _map(axes[row, column], result.config, signed[row][column], (-ends[0], ends[0]))
            _name(axes, row, column, f"{'AB'[row]}{column + 1}  {name}, {word}")
        _map(axes[row, -1], result.config, sizes[row], (0.0, ends[1]))
        _name(axes, row, -1, f"{'AB'[row]}{len(DIRECTIONS) + 1}  {name}, mean size")
    _bar(axes[:, :-1], signed, "deviation from the straight line, positive to the reach's left")
    _bar(axes[:, -1:], sizes, "mean of its size")
    with jc.plot.style():
        grey = Patch(
            color=axes[0, 0].collections[0].cmap.get_bad(),
            label=f"no reach within {100 * NEAREST:g} to {100 * FARTHEST:g} cm of the shoulder, "
            "which is at x = y = 0, or not solved; each cell stands for a reach of "
            f"{100 * result.config.distance:g} cm that starts at its centre",
        )
        fig.legend(handles=[grey], loc="outside lower center")
    return fig


def _map(ax: Any, config: Config, values: np.ndarray, limits: tuple[float, float]) -> None:
    """Draw one map within given limits, without its own colour bar."""
    jc.plot.workspace_map(*config.grid, values, label="", unit="%", diverging=limits[0] < 0, ax=ax)
    ax.collections[0].colorbar.remove()
    ax.collections[0].set_norm(Normalize(*limits))


def _name(axes: np.ndarray, row: int, column: int, text: str) -> None:
    """Give a map its title, and the outer ones alone the names of the axes."""
    ax = axes[row, column]
    with jc.plot.style():
        ax.set_title(text, loc="left")
    ax.label_outer()


def _bar(axes: np.ndarray, values: list[np.ndarray], text: str) -> None:
    """Draw the one colour bar of several maps, pointed where values lie beyond its ends."""
    mesh = axes[0, 0].collections[0]
    beyond = float(np.nanmax(np.abs(values))) > mesh.norm.vmax
    extend = "neither" if not beyond else "both" if mesh.norm.vmin < 0 else "max"
    with jc.plot.style():
        bar = axes[0, 0].figure.colorbar(
            mesh, ax=list(axes.flat), location="top", extend=extend, aspect=40 * axes.shape[1] / 4
        )
        bar.set_label(f"{text} [% of its length]")
        bar.outline.set_visible(False)


def claims(result: Result) -> list[Claim]:
    """Check the ends, then how much paths curve, where, in which direction, and alike or not."""
    found = []
    for name in MODELS:
        found += [_arrives(result, name), _slight(result, name), _area(result, name)]
    found += [_directions(result, name) for name in MODELS]
    return [*found, _alike(result)]


def _arrives(result: Result, name: str) -> Claim:
    data = result.data.sel(model=name)
    error, solved = data.error.values, data.solved.values
    return Claim(
        f"All reaches of minimum {name} are solved and arrive",
        "quality of the solutions in this experiment",
        f"confirmed by a second of {len(LEVELS)} starts, and within 1 mm",
        f"{solved.sum()} of {error.size} confirmed ({data.first.values.sum()} found from the first "
        f"start); of these the largest error is {1e3 * error[solved].max():.2f} mm",
        bool(solved.all() and error.max() <= 1e-3),
        ""
        if solved.all()
        else "the others are left out of maps and claims: the solver ends in different local "
        "optima from each start",
    )


def _slight(result: Result, name: str) -> Claim:
    values = _curvatures(result, name) / 100
    holds, text = slightly_curved(values[np.isfinite(values)])
    return Claim(
        f"Hand paths of minimum {name} are slightly curved",
        "Li (2006), section 3.4",
        "median deviation above 0.5 % of the length, 95 % of the reaches below 15 %; our limits",
        text,
        holds,
        "" if holds else "either the paths are straight, or more than one in twenty bends strongly",
    )


def _area(result: Result, name: str) -> Claim:
    """Compare the spread over positions with the curvature itself, direction by direction."""
    maps = _maps(result, name)
    texts = [
        f"{word} {np.nanmin(part):+.1f} to {np.nanmax(part):+.1f} %"
        for word, part in zip(DIRECTIONS.values(), maps, strict=True)
    ]
    spread = min(float(np.nanmax(part) - np.nanmin(part)) for part in maps)
    return Claim(
        f"Curvature of minimum {name} depends on the area of the workspace",
        "Li (2006), section 3.4",
        "over positions, deviation differs by more than 5 % of the length in every direction; our "
        "limit",
        "; ".join(texts),
        spread > 5,
        "" if spread > 5 else f"in one direction it differs by {spread:.1f} % only",
    )


def _directions(result: Result, name: str) -> Claim:
    """Compare transverse with radial reaches in front of the shoulder, and over all the area."""
    sizes, middle = np.abs(_maps(result, name)), np.abs(result.config.grid[0]) < 0.12
    (across, along), (across_all, along_all) = (
        [float(np.nanmean(part[i::2])) for i in (0, 1)] for part in (sizes[..., middle], sizes)
    )
    return Claim(
        f"Transverse reaches of minimum {name} curve more than radial ones",
        "reported of people by Flash (1987) and Wolpert, Ghahramani & Jordan (1994)",
        "mean size to the right and left larger by a tenth than forward and backward, |x| < "
        "12 cm; the tenth is ours",
        f"{across:.1f} against {along:.1f} % of the length; over the whole area "
        f"{across_all:.1f} against {along_all:.1f} %",
        across > 1.1 * along,
        ""
        if across > 1.1 * along
        else f"their sizes have the ratio {across / along:.2f}: what is reported of people does "
        "not follow from this model of this arm",
    )


def _alike(result: Result) -> Claim:
    """Correlate the curvatures of both models over the reaches that are solved by both."""
    pairs = np.stack([_curvatures(result, name) for name in MODELS])
    change, energy = pairs[:, np.isfinite(pairs).all(axis=0)]
    r, same = float(np.corrcoef(change, energy)[0, 1]), float((change * energy > 0).mean())
    return Claim(
        "Both models curve the same reaches to the same side",
        "Li (2006), section 3.4: both models alike",
        "correlation of signed curvature above 0.5; our limit",
        f"{r:.2f} over {change.size} reaches, {100 * same:.0f} % to the same side; mean size "
        f"{np.abs(change).mean():.1f} % of the length (torque change) and "
        f"{np.abs(energy).mean():.1f} % (energy)",
        r > 0.5,
        ""
        if r > 0.5
        else "the arm is the same: least excitation bends paths where few muscles then do the work",
    )
