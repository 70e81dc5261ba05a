"""Figure 4.2 of Li (2006): joint paths of the muscle-driven arm over the iterations of ILQR.

The thesis starts "from poor initial control - which produces an arbitrary movement" and does not
print it. Here each muscle starts with a constant excitation drawn from U[0, amplitude] (our
choice). What counts as converged is not printed either: reported is the iteration at which 95 % of
the whole drop of the cost is reached.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._chapter_4 import Case, paths_of
from ._result import Claim, Result

TARGET = np.array([1.0, 1.5])
START = (1.5, 1.5)
SHOWN = 12


@dataclass(frozen=True)
class Config:
    """Settings: duration [s], time steps, weight and amplitude of the start, and its seed."""

    duration: float = 0.5
    num_steps: int = 100
    effort: float = 1e-4
    amplitude: float = 0.3
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with a coarser time step."""
        return cls(num_steps=20)


def run(config: Config) -> Result:
    """Solve, and keep the path of each of the first iterations."""
    arm = jc.plants.MuscleArm()
    problem = jc.tasks.posture(
        arm, TARGET, config.duration, num_steps=config.num_steps, effort=config.effort
    )
    x0 = arm.at_rest(*START)
    levels = config.amplitude * jax.random.uniform(jax.random.key(config.seed), (arm.nu,))
    us = jnp.broadcast_to(levels, (config.num_steps, arm.nu))
    solution = jc.solve(problem, jc.ILQR(), x0, us)
    paths = paths_of(Case(problem, x0), us[None], tuple(range(SHOWN)))[:, 0]
    count = int(solution.num_steps) + 1
    failure = "" if bool(solution.status.ok) else solution.status.message
    data = xarray.Dataset(
        {
            "angles": (
                ("iteration", "time", "joint"),
                np.asarray(paths),
                {"long_name": "joint angle", "units": "rad"},
            ),
            "final": (
                ("time", "joint"),
                np.asarray(solution.xs[:, :2]),
                {"long_name": "joint angle at convergence", "units": "rad"},
            ),
            "cost": (
                "step",
                np.asarray(solution.history.cost[:count]),
                {"long_name": "cost of each iterate", "units": "1"},
            ),
        },
        coords={
            "time": ("time", np.asarray(problem.ts), {"long_name": "time", "units": "s"}),
            "joint": ("joint", ["shoulder", "elbow"], {"long_name": "joint"}),
        },
    )
    return Result(data, config, failure)


def figure(result: Result) -> Figure:
    """Draw elbow against shoulder for the first iterations, and the fall of the cost."""
    data = result.data
    fig, axes = jc.plot.panels(1, 2, size=(8.0, 3.4))
    jc.plot.joint_paths(data.angles.values, target=TARGET, ax=axes[0, 0])
    ax = axes[0, 1]
    above = data.cost.values[:-1] - data.cost.values[-1]
    ax.semilogy(np.arange(above.size), above)
    ax.set_xlabel("iteration")
    ax.set_ylabel("cost above the final one")
    return fig


def claims(result: Result) -> list[Claim]:
    """Compare with what the thesis says of its figure 4.2."""
    cost = result.data.cost.values
    reached = int(np.argmax(cost[0] - cost >= 0.95 * (cost[0] - cost[-1])))
    error = float(np.abs(result.data.final.values[-1] - TARGET).max())
    at_4 = float(np.abs(result.data.angles.values[min(5, SHOWN - 1), -1] - TARGET).max())
    return [
        Claim(
            "The cost falls in every iteration",
            "Li (2006), section 4.3.2",
            "monotone",
            f"largest rise {max(0.0, float(np.diff(cost).max())):.1e}",
            bool((np.diff(cost) <= 0).all()),
        ),
        Claim(
            "A good control is found in about 5 iterations",
            "Li (2006), section 4.3.2",
            "about 5",
            f"95 % of the cost's drop after {reached}; the joints are off by {at_4:.3f} rad "
            f"after 5; converged after {cost.size - 1}",
            reached <= 7,
            "The thesis states neither its start nor its stopping rule.",
        ),
        Claim(
            "The converged movement ends at (1, 1.5) rad",
            "Li (2006), fig. 4.2",
            "within 0.01 rad",
            f"largest error {error:.1e} rad",
            error < 0.01,
        ),
    ]
