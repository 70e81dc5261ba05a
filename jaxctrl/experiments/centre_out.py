"""Reaches of 10 cm in eight directions, by torques and by six muscles, with noisy repetitions.

The cost is Li's (2006), eq. 3.20, from the posture (pi/4, pi/2). ILQR plans without noise; its
feedback law then runs on the arm with motor noise proportional to each control: 0.02 s^(1/2), a
fifth of the control over 10 ms, and 0.05 s^(1/2), the thesis's half. The ranges with which the
movements are compared come from an independent implementation of the same costs and of arms whose
muscles have Brown's active state; they are not the thesis's.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _chapter_5 as shared
from ._planned import check_active_state, check_positive
from ._result import Claim, Result, named

ARMS = ("torque", "muscle")


@dataclass(frozen=True)
class Config(shared.Reaches):
    """Settings: those of the reaches, `motor_noise` being the weak one, the strong one [s^(1/2)],
    trials and seed; the muscles' active state, "linear", "brown" or "brown-fixed".

    The price of the last velocity, `velocity_weight` [s^2/m^2], is a tenth of that of `jc.tasks`:
    it is that of the implementation with which the movements are compared.
    """

    velocity_weight: float = 1e-3
    strong_noise: float = 0.05
    trials: int = 50
    seed: int = 0
    active_state: str = "linear"

    def __post_init__(self):
        check_active_state(self.active_state)
        check_positive(
            radius=self.radius, motor_noise=self.motor_noise, strong_noise=self.strong_noise
        )

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with fewer trials."""
        return cls(trials=2)


def _reach(arm: shared.Arm, config: Config):
    """Solve for every direction in one batch, and run the noisy trials of each.

    Returns: the variables of one arm, and why they cannot be trusted, if so.
    """
    x0 = arm.at_rest(*shared.START)
    problems = config.problems(arm, velocity_weight=config.velocity_weight, motor_noise=None)
    solutions = jc.solve_batch(problems, jc.ILQR(), x0)
    keys = jax.random.split(jax.random.key(config.seed), (config.directions, config.trials))

    def trial(level, problem, policy, key):
        noise = jc.SignalDependentNoise(level)
        return jax.vmap(arm.hand)(jc.simulate(problem, policy, x0, key=key, noise=noise).xs)

    over_keys = jax.vmap(trial, in_axes=(None, None, None, 0))
    over_directions = jax.vmap(over_keys, in_axes=(None, 0, 0, 0))
    levels = jnp.array([config.motor_noise, config.strong_noise])
    noisy = jax.vmap(over_directions, in_axes=(0, None, None, None))(
        levels, problems, solutions.policy, keys
    )
    data = config.planned(arm, solutions) | {
        "noisy": (
            ("noise", "direction", "trial", "time", "axis"),
            noisy,
            named("hand position in noisy trials", "m"),
        ),
        "peak_control": (
            "direction",
            np.abs(solutions.us).max(axis=(1, 2)),
            named("largest control (N m for torques, excitation for muscles)", "1"),
        ),
    }
    coords = config.coordinates()
    coords["noise"] = ("noise", np.asarray(levels), named("motor noise", "s^(1/2)"))
    failure = "" if bool(solutions.status.ok.all()) else solutions.status.message
    return xarray.Dataset(data, coords).as_numpy(), failure


def run(config: Config) -> Result:
    """Reach with both arms; arrays lead with the arm, but for the targets."""
    muscle = jc.plants.MuscleArm(active_state=config.active_state)  # pyright: ignore[reportArgumentType]
    arms = (jc.plants.TorqueArm(), muscle)
    parts, failures = zip(*(_reach(arm, config) for arm in arms), strict=True)
    label = xarray.Variable("arm", list(ARMS), {"long_name": "arm"})
    both = xarray.concat([part.drop_vars("target") for part in parts], dim="arm")
    data = both.assign(target=parts[0].target).assign_coords(arm=label)
    return Result(data, config, "; ".join(filter(None, failures)))


def _measures(data: xarray.Dataset, arm: str) -> dict[str, np.ndarray]:
    """Return for each direction the end error [m], peak speed, its time and the deviation [m]."""
    hand, speed = data.hand.sel(arm=arm).values, data.speed.sel(arm=arm).values
    target = data.target.values
    along = target - hand[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    offset = hand - hand[:, :1]
    across = offset[..., 0] * along[:, None, 1] - offset[..., 1] * along[:, None, 0]
    return {
        "error": np.linalg.norm(hand[:, -1] - target, axis=1),
        "peak": speed.max(axis=1),
        "time": data.time.values[speed.argmax(axis=1)],
        "deviation": np.abs(across).max(axis=1),
        "end_speed": speed[:, -1],
    }


def figure(result: Result) -> Figure:
    """Draw hand paths with their trials under both noises, and speed profiles; a row for an arm."""
    data = result.data
    angles = data.direction.values
    labels = [f"{angle:.0f}°" for angle in angles]
    fig, axes = jc.plot.panels(2, 3, size=(10.0, 6.2))
    for row, arm in zip(axes, ARMS, strict=True):
        for ax in row:
            ax.set_prop_cycle(color=jc.plot.direction_colours(np.radians(angles)))
        for ax, noise in zip(row, data.noise.values, strict=False):
            part = data.noisy.sel(arm=arm, noise=noise)
            jc.plot.hand_paths(list(part.values), data.target.values, labels=labels, ax=ax)
            ax.get_legend().remove()
            with jc.plot.style():
                ax.set_title(f"{arm}s, noise {noise:g} s$^{{1/2}}$", loc="left")
        speeds = list(data.speed.sel(arm=arm).values)
        jc.plot.speed_profiles(data.time, speeds, labels=labels, ax=row[-1])
        with jc.plot.style():
            row[-1].set_title(f"{arm}s, planned", loc="left")
    axes[1, -1].get_legend().remove()
    top = max(ax.get_ylim()[1] for ax in axes[:, -1])
    for ax in axes[:, -1]:
        ax.set_ylim(0, top)
    return fig


RANGES = {
    "torque": {"error": 1e-4, "peak": (0.295, 0.302), "deviation": (0.001, 0.012)},
    "muscle": {"error": 2e-5, "peak": (0.29, 0.44), "deviation": (0.002, 0.035)},
}


TWO_PEAKS = (
    "the cheapest movement of the six muscles is not quite bell-shaped: along 0 and 180 degrees, "
    "where the path bends most, the speed dips between two maxima"
)


def claims(result: Result) -> list[Claim]:
    """Compare end errors, peak speeds and deviations with those of the other implementation."""
    found, source = [], "values recorded from a separate implementation of Li's arms and cost"
    for arm, wanted in RANGES.items():
        got = _measures(result.data, arm)
        error, iterations = got["error"].max(), result.data.iterations.sel(arm=arm).values
        found.append(
            Claim(
                f"The {arm}-driven hand ends on its target in all directions",
                source,
                f"within {1e3 * wanted['error']:.2f} mm",
                f"largest error {1e3 * error:.3f} mm, end speed {got['end_speed'].max():.4f} m/s, "
                f"{iterations.min()}-{iterations.max()} iterations",
                error <= wanted["error"],
            )
        )
        for name, unit, scale, text in (
            ("peak", "m/s", 1.0, "Peak speeds"),
            ("deviation", "mm", 1e3, "Deviations from the straight line"),
        ):
            low, high = wanted[name]
            least, most = got[name].min(), got[name].max()
            slack = 0.1 * (high - low)
            found.append(
                Claim(
                    f"{text} of the {arm}-driven arm lie in the range found elsewhere",
                    source,
                    f"{scale * low:.3g}-{scale * high:.3g} {unit}, give or take a tenth of it",
                    f"{scale * least:.3g}-{scale * most:.3g} {unit}",
                    low - slack <= least and most <= high + slack,
                )
            )
        single = [_peaks(speed) == 1 for speed in result.data.speed.sel(arm=arm).values]
        found.append(
            Claim(
                f"Speed profiles of the {arm}-driven arm have one peak",
                "Li (2006), chapter 3",
                "bell-shaped: one maximum in every direction",
                f"one maximum in {sum(single)} of {len(single)} directions, counting those that "
                "stand out by 1 % of the largest",
                all(single),
                "" if all(single) else TWO_PEAKS,
            )
        )
    return found


def _peaks(speed: np.ndarray) -> int:
    """Count the maxima that stand out by more than 1 % of the largest."""
    from scipy.signal import find_peaks

    return len(find_peaks(np.append(speed, 0.0), prominence=0.01 * speed.max())[0])
