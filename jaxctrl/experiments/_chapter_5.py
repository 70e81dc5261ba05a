"""What the figures of chapter 5 of Li (2006) share: reaches around one posture, and ellipses."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from scipy.stats import chi2

import jaxctrl as jc

from ._result import Claim, named

Arm = jc.plants.TorqueArm | jc.plants.MuscleArm
START = (np.pi / 4, np.pi / 2)
"""Shoulder and elbow at the start [rad]; our choice."""
NEAR = 0.005
"""What counts as on target [m]; our choice."""
COVERAGE = 0.95
"""What fraction of the end points an ellipse holds, were they normally distributed."""


def angles(count: int) -> np.ndarray:
    """Return directions [rad] (count,), the first along +x, counter-clockwise."""
    return 2 * np.pi * np.arange(count) / count


@dataclass(frozen=True)
class Reaches:
    """Settings of reaches around the start: radius [m], duration [s], time steps, directions,
    effort, and motor noise [s^(1/2)]. A figure adds what else it needs."""

    radius: float = 0.1
    duration: float = 0.5
    num_steps: int = 50
    directions: int = 8
    effort: float = 1e-4
    motor_noise: float = 0.02

    def problems(self, arm: Arm, **changes: Any) -> jc.Problem:
        """Return the reaches from START as a batch; `changes` go to `jc.tasks.centre_out`."""
        settings = {
            "n": self.directions,
            "radius": self.radius,
            "duration": self.duration,
            "num_steps": self.num_steps,
            "effort": self.effort,
            "motor_noise": self.motor_noise,
        }
        return jc.tasks.centre_out(arm, arm.at_rest(*START), **(settings | changes))

    def targets(self, arm: Arm) -> np.ndarray:
        """Return the targets [m], (directions, 2)."""
        turn = angles(self.directions)
        around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return np.asarray(arm.hand(arm.at_rest(*START))) + self.radius * around

    def planned(self, arm: Arm, found: jc.Solution) -> dict[str, Any]:
        """Return the variables hand, speed, iterations and target of one solution per direction."""
        along = ("direction", "time")
        velocity = jax.vmap(jax.vmap(arm.hand_velocity))(found.xs)
        hand = jax.vmap(jax.vmap(arm.hand))(found.xs)
        return {
            "hand": ((*along, "axis"), hand, named("planned hand position", "m")),
            "speed": (along, np.linalg.norm(velocity, axis=-1), named("planned hand speed", "m/s")),
            "iterations": ("direction", found.num_steps, named("iterations", "1")),
            "target": (("direction", "axis"), self.targets(arm), named("target", "m")),
        }

    def coordinates(self, *more: str) -> dict[str, Any]:
        """Return the coordinates direction, time and axis, and, if wanted, "step" (where a control
        begins) and "other" (of two axes)."""
        time = np.linspace(0, self.duration, self.num_steps + 1)
        turn = np.degrees(angles(self.directions))
        known = {
            "direction": ("direction", turn, named("direction", "degree")),
            "time": ("time", time, named("time", "s")),
            "axis": ("axis", ["x", "y"], {"long_name": "axis"}),
            "step": ("step", time[:-1], named("time at which the control begins", "s")),
            "other": ("other", ["x", "y"], {"long_name": "other axis of a covariance"}),
        }
        return {name: known[name] for name in ("direction", "time", "axis", *more)}


def hand_cov(arm: jc.AbstractArm, xs, x_cov) -> np.ndarray:
    """Return the covariance of the hand [m^2] (n, 2, 2) of states (n, nx), to first order."""
    slope = jax.vmap(jax.jacfwd(arm.hand))(xs)
    return np.asarray(slope @ x_cov @ jnp.swapaxes(slope, 1, 2))


def spread(cov: np.ndarray) -> np.ndarray:
    """Return the standard deviation along both axes together [m], (...), of (..., 2, 2)."""
    return np.sqrt(np.trace(cov, axis1=-2, axis2=-1))


def draw_ellipse(ax: Axes, centre: np.ndarray, cov: np.ndarray, scale: float, **look: Any) -> None:
    """Draw the 95 % ellipse of a covariance [m^2] at a centre [cm], `scale` times too large."""
    variances, axes = np.linalg.eigh(cov)
    radius = 100 * scale * np.sqrt(chi2.ppf(COVERAGE, 2))
    half = radius * np.sqrt(np.maximum(variances[::-1], 0.0))
    degrees = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    look = {"fill": False, "linewidth": 1.2, "zorder": 4} | look
    ax.add_patch(Ellipse(tuple(centre), 2 * half[0], 2 * half[1], angle=degrees, **look))
    reach = radius * np.sqrt(np.diag(cov))
    ax.update_datalim([centre - reach, centre + reach])
    ax.autoscale_view()


def end_errors(data: xarray.Dataset) -> np.ndarray:
    """Return how far each planned movement ends from its target [m], (direction,)."""
    return np.linalg.norm(data.hand.values[:, -1] - data.target.values, axis=1)


def colour_directions(ax: Axes, data: xarray.Dataset) -> None:
    """Let the Axes draw one direction after the other, each in its colour."""
    ax.set_prop_cycle(color=jc.plot.direction_colours(np.radians(data.direction.values)))


def on_compass(ax: Axes) -> None:
    """Label a horizontal axis of directions [degree] by quarter turns."""
    ax.set_xlim(-15, 375)
    ax.set_xticks([0, 90, 180, 270, 360])
    ax.set_xlabel("direction [°]")


def bells(data: xarray.Dataset, source: str, why: str = "") -> Claim:
    """Judge whether the speed has a single peak in every direction; `why` is said if not."""
    profiles = [jc.analysis.speed_peaks(data.time.values, speed) for speed in data.speed.values]
    single = [len(profile.peak_times) == 1 for profile in profiles]
    highest = [profile.peak_speeds.max() for profile in profiles]
    first = [profile.peak_times[0] for profile in profiles]
    return Claim(
        "The speed has one peak in all directions",
        source,
        "bell-shaped: one maximum in every direction",
        f"one maximum in {sum(single)} of {len(single)} directions, counting those that stand out "
        f"by 1 % of the largest; {min(highest):.2f}-{max(highest):.2f} m/s, the first at "
        f"{min(first):.2f}-{max(first):.2f} s",
        all(single),
        "" if all(single) else why,
    )
