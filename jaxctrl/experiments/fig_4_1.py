"""Figure 4.1 of Li (2006): optimal trajectories of three control problems, found by ILQR.

A: the two-link arm moved by torques, and B: by six muscles, from one posture to (1, 1.5) rad, cost
(4.20) with the stopping term that the text asks for; C: the pendulum swung up, cost (4.23), from
three starts. The thesis prints the target, the pendulum's constants and its second start; the
arms' start (1.5, 1.5) rad, the other two starts of the pendulum and the durations are read off the
figure's axes and are our choice. The pendulum's starts are the same height and differ in side.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._result import Claim, Result, named

TARGET = np.array([1.0, 1.5])
START = (1.5, 1.5)
STARTS = (np.pi / 2, np.pi, 3 * np.pi / 2)


@dataclass(frozen=True)
class Config:
    """Settings: duration [s] of all movements, number of time steps, and the control's weight."""

    duration: float = 0.5
    num_steps: int = 100
    effort: float = 1e-4
    pendulum_effort: float = 1e-5

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with a coarser time step."""
        return cls(num_steps=20)


def run(config: Config) -> Result:
    """Solve the five problems; arrays lead with the arm, or the pendulum's start, then time."""
    arms, statuses, angles = (jc.plants.TorqueArm(), jc.plants.MuscleArm()), [], []
    for arm in arms:
        problem = jc.tasks.posture(
            arm, TARGET, config.duration, num_steps=config.num_steps, effort=config.effort
        )
        solution = jc.solve(problem, jc.ILQR(), arm.at_rest(*START))
        statuses.append(solution.status)
        angles.append(solution.xs[:, :2])
    pendulum = jc.tasks.swing_up(
        jc.plants.Pendulum(),
        config.duration,
        num_steps=config.num_steps,
        effort=config.pendulum_effort,
    )
    starts = jnp.stack([jnp.array(STARTS), jnp.zeros(3)], axis=1)
    swings = jax.vmap(lambda x0: jc.solve(pendulum, jc.ILQR(), x0))(starts)
    statuses.append(swings.status)
    failed = [status.message for status in statuses if not bool(status.ok.all())]
    data = xarray.Dataset(
        {
            "angles": (("arm", "time", "joint"), np.stack(angles), named("joint angle", "rad")),
            "pendulum": (
                ("start", "time", "state"),
                np.asarray(swings.xs),
                named("angle from upright and its rate", "rad, rad/s"),
            ),
        },
        coords={
            "time": ("time", _times(pendulum), named("time", "s")),
            "arm": ("arm", ["torque", "muscle"], {"long_name": "arm"}),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
            "start": ("start", ["S1", "S2", "S3"], {"long_name": "start of the pendulum"}),
            "state": ("state", ["angle", "rate"], {"long_name": "state of the pendulum"}),
        },
    )
    return Result(data, config, "; ".join(failed))


def _times(problem: jc.Problem) -> np.ndarray:
    return np.asarray(problem.ts)


def figure(result: Result) -> Figure:
    """Draw joint angles of both arms over time, and the pendulum in its phase plane."""
    data = result.data
    fig, axes = jc.plot.panels(1, 3, size=(10.0, 3.0))
    for ax, arm, title in zip(axes[0], ("torque", "muscle"), ("A  torques", "B  six muscles")):  # noqa: B905
        jc.plot.trajectories(
            data.time,
            data.angles.sel(arm=arm),
            names=["shoulder", "elbow"],
            unit="rad",
            targets=TARGET,
            ax=ax,
        )
        ax.set_ylabel("joint angle [rad]")
        with jc.plot.style():
            ax.set_title(title, loc="left")
    jc.plot.phase(
        list(data.pendulum.values), labels=list(data.start.values), target=(0, 0), ax=axes[0, 2]
    )
    with jc.plot.style():
        axes[0, 2].set_title("C  pendulum", loc="left")
    return fig


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.1."""
    data, found = result.data, []
    for arm, panel in (("torque", "A"), ("muscle", "B")):
        error = float(np.abs(data.angles.sel(arm=arm).values[-1] - TARGET).max())
        found.append(
            Claim(
                f"The joints of the {arm}-driven arm arrive at (1, 1.5) rad",
                f"Li (2006), fig. 4.1{panel}",
                "within 0.01 rad",
                f"largest error {error:.1e} rad",
                error < 0.01,
            )
        )
    ends = np.abs(data.pendulum.values[:, -1])
    found.append(
        Claim(
            "The pendulum stands upright and still at the end, from each of three starts",
            "Li (2006), fig. 4.1C",
            "within 0.05 rad and 0.05 rad/s",
            f"largest error {ends[:, 0].max():.1e} rad, {ends[:, 1].max():.1e} rad/s",
            bool((ends < 0.05).all()),
        )
    )
    hanging = data.pendulum.sel(start="S2", state="angle").values
    found.append(
        Claim(
            "From hanging down (S2) it swings directly up, without swinging back first",
            "Li (2006), section 4.3.2",
            "angle falls all the way",
            f"largest rise in a step {np.diff(hanging).max():.1e} rad",
            bool(np.diff(hanging).max() <= 1e-3),
        )
    )
    speed = float(np.abs(data.pendulum.sel(state="rate")).max())
    found.append(
        Claim(
            "Its rate stays within the figure's axis",
            "Li (2006), fig. 4.1C",
            "0 ... -15 rad/s",
            f"at most {speed:.1f} rad/s",
            speed <= 15,
        )
    )
    return found
