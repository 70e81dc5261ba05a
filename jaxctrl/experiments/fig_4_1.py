"""Figure 4.1 of Li (2006): optimal trajectories of three control problems, found by ILQR.

A: the two-link arm moved by torques, and B: by six muscles, from one posture to (1, 1.5) rad, cost
(4.20) as printed, and with the stopping term that the text asks for and the formula lacks; C: the
pendulum swung up, cost (4.23), from three starts. The thesis prints the target, the pendulum's
constants and its second start; the arms' start (1.5, 1.5) rad, the other two starts of the pendulum
and the durations are read off the figure's axes and are our choice. The pendulum's starts are the
same height and differ in side. The arms' panels have the thesis's axes, which cut what leaves them.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from ._chapter_4 import COSTS, TARGET, arm_case, outside
from ._result import Claim, Result, named

AXES = np.array([[1.0, 1.3], [1.5, 1.6]])
"""The axes of the thesis's figure: shoulder and elbow, from and to [rad]."""
EDGE = 0.01
"""What counts as within them [rad]."""
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
    """Solve the seven problems; arrays lead with the cost and the arm, or the pendulum's start."""
    statuses, angles = [], []
    for cost in COSTS:
        for arm in ("torque", "muscle"):
            case = arm_case(
                arm,
                config.num_steps,
                stop=cost == "stop",
                duration=config.duration,
                effort=config.effort,
            )
            solution = jc.solve(case.problem, jc.ILQR(), case.x0)
            statuses.append(solution.status)
            angles.append(np.asarray(solution.xs[:, :2]))
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
            "angles": (
                ("cost", "arm", "time", "joint"),
                np.stack(angles).reshape(2, 2, *angles[0].shape),
                named("joint angle", "rad"),
            ),
            "pendulum": (
                ("start", "time", "state"),
                np.asarray(swings.xs),
                named("angle from upright and its rate", "rad, rad/s"),
            ),
        },
        coords={
            "time": ("time", np.asarray(pendulum.ts), named("time", "s")),
            "cost": ("cost", list(COSTS), {"long_name": "cost (4.20), and with a stopping term"}),
            "arm": ("arm", ["torque", "muscle"], {"long_name": "arm"}),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
            "start": ("start", ["S1", "S2", "S3"], {"long_name": "start of the pendulum"}),
            "state": ("state", ["angle", "rate"], {"long_name": "state of the pendulum"}),
        },
    )
    return Result(data, config, "; ".join(failed))


def figure(result: Result) -> Figure:
    """Draw joint angles of both arms over time, and the pendulum in its phase plane."""
    data = result.data
    fig, axes = jc.plot.panels(2, 3, size=(10.0, 4.4), sharex=True)
    for column, (arm, title) in enumerate((("torque", "A  torques"), ("muscle", "B  six muscles"))):
        for row in range(2):
            with jc.plot.style():
                _draw_joint(axes[row, column], data.sel(arm=arm), row)
        with jc.plot.style():
            axes[0, column].set_title(title, loc="left")
            axes[1, column].set_xlabel("time [s]")
    grid = axes[0, 2].get_gridspec()
    for ax in axes[:, 2]:
        ax.remove()
    with jc.plot.style():
        swings = fig.add_subplot(grid[:, 2])
        axes[1, 1].legend(loc="lower right")
        fig.align_ylabels(axes[:, :2])
    jc.plot.phase(
        list(data.pendulum.values), labels=list(data.start.values), target=(0, 0), ax=swings
    )
    with jc.plot.style():
        swings.set_title("C  pendulum", loc="left")
    return fig


def _draw_joint(ax: Axes, data: xarray.Dataset, row: int) -> None:
    """Draw one joint's angle over time under both costs, in the thesis's axes."""
    joint = str(data.joint.values[row])
    words = []
    for i, cost in enumerate(COSTS):
        angle = data.angles.sel(cost=cost, joint=joint).values
        ax.plot(data.time, angle, color=f"C{i}", linestyle=("-", "--")[i], label=COSTS[cost])
        window = AXES[:, row] + np.array([-EDGE, EDGE])
        ends = [e for e in (angle.min(), angle.max()) if not window[0] <= e <= window[1]]
        if ends:
            words.append(f"{COSTS[cost]}: to " + " and ".join(f"{end:.2f}" for end in ends))
    if words:
        ax.annotate(
            "leaves the axes\n" + "\n".join(words), (0.03, 0.06), xycoords="axes fraction",
            fontsize=7, color="0.35",
        )  # fmt: skip
    ax.axhline(TARGET[row], color="0.6", linestyle=":", zorder=0, label="target")
    ax.set_xlim(0, float(data.time[-1]))
    ax.set_ylim(AXES[0, row] - EDGE, AXES[1, row] + EDGE)
    ax.set_ylabel(f"{joint} [rad]")


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.1."""
    return [*_of_arms(result.data), *_of_the_pendulum(result.data)]


def _of_arms(data: xarray.Dataset) -> list[Claim]:
    found = []
    for cost, words in COSTS.items():
        for arm, panel in (("torque", "A"), ("muscle", "B")):
            angles, source = data.angles.sel(cost=cost, arm=arm).values, f"fig. 4.1{panel}"
            error = float(np.abs(angles[-1] - TARGET).max())
            found.append(
                Claim(
                    f"The joints of the {arm}-driven arm arrive at (1, 1.5) rad, {words}",
                    f"Li (2006), {source}",
                    "within 0.01 rad",
                    f"largest error {error:.1e} rad",
                    error < 0.01,
                )
            )
            low, high = angles.min(axis=0), angles.max(axis=0)
            inside = not outside(angles, AXES + np.array([[-EDGE], [EDGE]]))
            found.append(
                Claim(
                    f"The joints of the {arm}-driven arm stay within the figure's axes, {words}",
                    f"Li (2006), {source}",
                    "shoulder 1 to 1.5, elbow 1.3 to 1.6 rad",
                    f"shoulder {low[0]:.3f} to {high[0]:.3f}, elbow {low[1]:.3f} to "
                    f"{high[1]:.3f} rad",
                    inside,
                    ""
                    if inside
                    else "The thesis states neither its start nor which of the costs it has.",
                )
            )
    return found


def _of_the_pendulum(data: xarray.Dataset) -> list[Claim]:
    ends = np.abs(data.pendulum.values[:, -1])
    hanging = data.pendulum.sel(start="S2", state="angle").values
    speed = float(np.abs(data.pendulum.sel(state="rate")).max())
    return [
        Claim(
            "The pendulum stands upright and still at the end, from each of three starts",
            "Li (2006), fig. 4.1C",
            "within 0.05 rad and 0.05 rad/s",
            f"largest error {ends[:, 0].max():.1e} rad, {ends[:, 1].max():.1e} rad/s",
            bool((ends < 0.05).all()),
        ),
        Claim(
            "From hanging down (S2) it swings directly up, without swinging back first",
            "Li (2006), section 4.3.2",
            "angle falls all the way",
            f"largest rise in a step {np.diff(hanging).max():.1e} rad",
            bool(np.diff(hanging).max() <= 1e-3),
        ),
        Claim(
            "Its rate stays within the figure's axis",
            "Li (2006), fig. 4.1C",
            "0 ... -15 rad/s",
            f"at most {speed:.1f} rad/s",
            speed <= 15,
        ),
    ]
