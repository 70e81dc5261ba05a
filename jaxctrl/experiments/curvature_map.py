"""How much the path of a 10 cm reach curves, over the workspace in front of the body.

"Slightly curved hand path does occur, depending on the area of the workspace" (Li 2006, section
3.4). Reaches in four directions start from a grid of positions: under minimum torque change with
the torque arm on a fine grid, under minimum energy with the six muscles on a coarser one. Reaches
that leave the area in which neither the arm is nearly straight nor the elbow nearly closed are left
out. Grid, distance and duration are our choice.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._result import Claim, Result, named

MODELS = ("torque", "muscle")
TITLES = {"torque": "torque change", "muscle": "muscle energy"}
NAMES = {
    "torque": "minimum torque change (torque arm)",
    "muscle": "minimum energy (six muscles)",
}
DIRECTIONS = {0: "right", 90: "forward", 180: "left", 270: "backward"}
"""Directions of the reaches [degree from +x]: transverse and radial by turns."""

AREA = ((-0.35, 0.35), (0.2, 0.55))
"""Ranges of x and y [m] from which reaches start; the shoulder is at the origin."""

NEAREST, FARTHEST = 0.15, 0.58
"""Distances [m] of the hand from the shoulder: elbow at 149 and at 45 degrees."""

LEVELS = {"torque": (0.0,), "muscle": (0.02, 0.05, 0.1)}
"""Constant controls from which each reach is solved; the cheapest result is kept."""

AGREE = (0.01, 0.02)
"""How far two starts may differ in cost, as a fraction, and in curvature, to confirm each other."""

NEAR = (int(jc.Reason.NEARLY_CONVERGED), int(jc.Reason.STALLED))
"""How a solve may end when another confirms it: the muscles' curves have kinks, in which the
gradient does not vanish."""

SLIGHT = 0.15
"""What counts as slight: deviation from the straight line over its length."""


@dataclass(frozen=True)
class Config:
    """Settings: columns and rows of the fine grid, and the `stride` that leaves the coarser one.

    distance [m], duration [s] and number of time steps of each reach; `effort` of the muscles, and
    their active state, "linear", "brown" or "brown-fixed".
    """

    columns: int = 15
    rows: int = 9
    stride: int = 2
    distance: float = 0.1
    duration: float = 0.5
    num_steps: int = 50
    effort: float = 1e-4
    active_state: str = "linear"

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with a coarser grid and time step."""
        return cls(columns=4, rows=3, num_steps=25)


def _starts(config: Config, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return column, row and direction (n, 3) of all reaches, their starts and targets (n, 2)."""
    (left, right), (near, far) = AREA
    x, y = np.linspace(left, right, config.columns), np.linspace(near, far, config.rows)
    where, starts, targets = [], [], []
    for row in range(0, config.rows, stride):
        for column in range(0, config.columns, stride):
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


def _solve(name: str, config: Config) -> xarray.Dataset:
    """Solve all reaches of a model in one batch, and measure their curvature."""
    muscles = name == "muscle"
    arm = jc.plants.TorqueArm()
    if muscles:
        arm = jc.plants.MuscleArm(active_state=config.active_state)  # pyright: ignore[reportArgumentType]
    where, starts, targets = _starts(config, config.stride if muscles else 1)

    model: jc.models.AbstractModel = jc.models.MinimumTorqueChange()  # pyright: ignore[reportCallIssue]
    if muscles:
        model = jc.models.MinimumEnergy(config.effort)  # pyright: ignore[reportCallIssue]

    def task(target):
        return jc.tasks.reach(arm, target, config.duration, num_steps=config.num_steps)

    at = [arm.at_rest(*arm.inverse_kinematics(start)) for start in starts]
    at = jnp.stack([model.start(task(targets[0]), x0) for x0 in at])
    problems = jax.vmap(lambda target: model.problem(task(target)))(jnp.array(targets))
    plant = jax.tree.map(lambda leaf: leaf[0], problems).plant
    hands, costs = [], []
    for level in LEVELS[name]:
        controls = jnp.full((len(targets), config.num_steps, plant.nu), level)
        solved = jc.solve_batch(problems, jc.ILQR(), at, controls)
        code = np.asarray(solved.status.code)
        usable = np.asarray(solved.status.ok) | (len(LEVELS[name]) > 1) & np.isin(code, NEAR)
        hands.append(np.asarray(jax.vmap(jax.vmap(plant.hand))(solved.xs)))
        costs.append(np.where(usable, np.asarray(solved.cost), np.inf))
    return _measured(where, starts, targets, np.array(hands), np.array(costs), config)


def _measured(where, starts, targets, hands, costs, config: Config) -> xarray.Dataset:
    """Keep the cheapest of the solutions from several starts (starts, n, ...), and label it.

    With several starts one counts as solved where another agrees with it.
    """
    strays = jc.analysis.deviation(hands) / config.distance
    lane, cheapest = np.arange(len(starts)), costs.argmin(axis=0)
    hand, stray, least = hands[cheapest, lane], strays[cheapest, lane], costs[cheapest, lane]
    alike = (costs <= (1 + AGREE[0]) * least) & (np.abs(strays - stray) <= AGREE[1])
    solved = np.isfinite(least) & (alike.sum(axis=0) >= min(2, len(costs)))
    error = np.linalg.norm(hand[:, -1] - targets, axis=1)
    return xarray.Dataset(
        {
            "start": (("reach", "axis"), starts, named("start of the hand", "m")),
            "target": (("reach", "axis"), targets, named("target", "m")),
            "cell": (("reach", "index"), where, named("column, row and direction", "1")),
            "hand": (("reach", "time", "axis"), hand, named("hand position", "m")),
            "curvature": (
                "reach",
                stray,
                named("deviation to the left of the straight line, over its length", "1"),
            ),
            "error": ("reach", error, named("distance from the target at the end", "m")),
            "solved": ("reach", solved, named("whether it is solved, and confirmed", "1")),
        },
        coords={
            "time": (
                "time",
                np.linspace(0, config.duration, config.num_steps + 1),
                named("time", "s"),
            ),
            "axis": ("axis", ["x", "y"], {"long_name": "axis"}),
        },
    )


def run(config: Config) -> Result:
    """Reach from every start with both models; their variables have the models' names in front."""
    parts = []
    for name in MODELS:
        part = _solve(name, config)
        own = {key: f"{name}_{key}" for key in [*part.data_vars, "reach"]}
        parts.append(part.rename(own))
    data = xarray.Dataset().merge(parts[0]).merge(parts[1])
    failed = [
        f"{NAMES[name]}: only {100 * share:.0f} % of the reaches are solved"
        for name in MODELS
        if (share := float(data[f"{name}_solved"].mean())) < 0.5
    ]
    return Result(data, config, "; ".join(failed))


def _curvatures(result: Result, name: str) -> np.ndarray:
    """Return a model's curvatures, NaN where a reach is not solved."""
    data = result.data
    return np.where(data[f"{name}_solved"].values, data[f"{name}_curvature"].values, np.nan)


def _grid(result: Result, name: str, direction: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and the curvatures (ny, nx) of a model and direction, NaN where there is none."""
    config, stride = result.config, result.config.stride if name == "muscle" else 1
    (left, right), (near, far) = AREA
    x = np.linspace(left, right, config.columns)[::stride]
    y = np.linspace(near, far, config.rows)[::stride]
    values = np.full((y.size, x.size), np.nan)
    cells = result.data[f"{name}_cell"].values
    for (column, row, k), value in zip(cells, _curvatures(result, name), strict=True):
        if k == direction:
            values[row // stride, column // stride] = value
    return x, y, values


def figure(result: Result) -> Figure:
    """Map the signed curvature of each direction, and its mean magnitude; one row for a model.

    Each row has one scale. Grey: out of reach, or not solved.
    """
    columns = len(DIRECTIONS) + 1
    fig, axes = jc.plot.panels(len(MODELS), columns, size=(13.0, 4.6))
    for row, name in zip(axes, MODELS, strict=True):
        grids = [_grid(result, name, k) for k in range(len(DIRECTIONS))]
        largest = max(np.nanmax(np.abs(values)) for _, _, values in grids)
        for ax, (x, y, values), word in zip(row, grids, DIRECTIONS.values(), strict=False):
            label = f"{TITLES[name]}, {word}"
            jc.plot.workspace_map(x, y, values, label=label, unit="", diverging=True, ax=ax)
            ax.collections[0].set_clim(-largest, largest)
        stack = np.abs([values for _, _, values in grids])
        counted = np.isfinite(stack).sum(axis=0)
        mean = np.nansum(stack, axis=0) / np.where(counted > 0, counted, np.nan)
        x, y, _ = grids[0]
        label = f"{TITLES[name]}, magnitude"
        jc.plot.workspace_map(x, y, mean, label=label, unit="", ax=row[-1])
    return fig


def claims(result: Result) -> list[Claim]:
    """Check the ends, then how much paths curve, where, in which direction, and alike or not."""
    found = []
    for name in MODELS:
        found += [_arrives(result, name), _slight(result, name), _area(result, name)]
    found += [_directions(result, name) for name in MODELS]
    return [*found, _alike(result)]


def _by_direction(result: Result, name: str) -> list[np.ndarray]:
    """Return the curvatures of each direction, without those that failed."""
    k, values = result.data[f"{name}_cell"].values[:, 2], _curvatures(result, name)
    return [values[(k == i) & np.isfinite(values)] for i in range(len(DIRECTIONS))]


def _arrives(result: Result, name: str) -> Claim:
    data, starts = result.data, len(LEVELS[name])
    error, solved = data[f"{name}_error"].values, data[f"{name}_solved"].values
    how = "solved" if starts == 1 else f"confirmed by a second of {starts} starts"
    return Claim(
        f"All reaches of {NAMES[name]} are solved and arrive",
        "quality of the solutions in this experiment",
        "within 1 mm",
        f"{solved.sum()} of {error.size} {how}; of these the largest error is "
        f"{1e3 * error[solved].max():.2f} mm",
        bool(solved.all() and error.max() <= 1e-3),
        ""
        if solved.all()
        else "The others are left out of maps and claims: there the cost hardly "
        "depends on the path, and the solver ends in different local optima.",
    )


def _slight(result: Result, name: str) -> Claim:
    values = np.abs(np.concatenate(_by_direction(result, name)))
    share = (values < SLIGHT).mean()
    return Claim(
        f"Hand paths of {NAMES[name]} are slightly curved",
        "Li (2006), section 3.4",
        f"deviation over length above 0.005 and below {SLIGHT:g} in most reaches; our limits",
        f"median {np.median(values):.3f}, 95 % below {np.percentile(values, 95):.3f}, largest "
        f"{values.max():.3f}; {100 * share:.0f} % below {SLIGHT:g}",
        bool(np.median(values) > 0.005 and share > 0.5),
        "" if share > 0.9 else "the others are curved strongly, up to the largest value",
    )


def _area(result: Result, name: str) -> Claim:
    """Compare the spread over positions with the curvature itself, direction by direction."""
    groups = _by_direction(result, name)
    texts = [
        f"{word} {group.min():+.3f} to {group.max():+.3f}"
        for word, group in zip(DIRECTIONS.values(), groups, strict=True)
    ]
    spread = min(float(np.ptp(group)) for group in groups)
    return Claim(
        f"Curvature of {NAMES[name]} depends on the area of the workspace",
        "Li (2006), section 3.4",
        "over positions, deviation over length differs by more than 0.05 in every direction; our "
        "limit",
        "; ".join(texts),
        spread > 0.05,
        "" if spread > 0.05 else "so few positions do not show it in every direction",
    )


def _directions(result: Result, name: str) -> Claim:
    """Compare transverse with radial reaches in front of the shoulder, and over all the area."""
    data = result.data
    k, values = data[f"{name}_cell"].values[:, 2], np.abs(_curvatures(result, name))
    middle = np.abs(data[f"{name}_start"].values[:, 0]) < 0.12
    solved = np.isfinite(values)
    means = [
        [values[solved & part & (k % 2 == odd)].mean() for odd in (0, 1)]
        for part in (middle, np.ones_like(middle))
    ]
    (across, along), (across_all, along_all) = means
    return Claim(
        f"Transverse reaches of {NAMES[name]} curve more than radial ones",
        "reported of people by Flash (1987) and Wolpert, Ghahramani & Jordan (1994)",
        "mean magnitude to the right and left larger by a tenth than forward and backward, |x| < "
        "12 cm; the tenth is ours",
        f"{across:.3f} against {along:.3f}; over the whole area {across_all:.3f} against "
        f"{along_all:.3f}",
        across > 1.1 * along,
        "" if across > 1.1 * along else "both curve about as much",
    )


def _alike(result: Result) -> Claim:
    """Correlate the curvatures of both models over the reaches that they share."""
    data = result.data
    curved = [
        dict(zip(map(tuple, data[f"{name}_cell"].values), _curvatures(result, name)))  # noqa: B905
        for name in MODELS
    ]
    pairs = np.array([(curved[0][cell], value) for cell, value in curved[1].items()])
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    r = float(np.corrcoef(pairs.T)[0, 1])
    same = float((pairs[:, 0] * pairs[:, 1] > 0).mean())
    return Claim(
        "Both models curve the same reaches to the same side",
        "Li (2006), section 3.4: both models alike",
        "correlation of signed curvature above 0.5; our limit",
        f"{r:.2f} over {len(pairs)} shared reaches, {100 * same:.0f} % to the same side; muscles "
        f"{np.abs(pairs[:, 1]).mean() / np.abs(pairs[:, 0]).mean():.1f} times as curved",
        r > 0.5,
        ""
        if r > 0.5
        else "Cost and arm both differ; which of them turns the paths is not told apart here.",
    )
