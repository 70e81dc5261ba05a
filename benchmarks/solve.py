"""Time warm solves and first calls of ILQR, each apart, on three problems of the package.

Run by `make bench`. Medians over repetitions; the machine's noise is their spread. Absolute times
mean little on another machine: compare ratios within one run.
"""

import statistics
import time

import jax
import jax.numpy as jnp

import jaxctrl as jc


def problems():
    """Return each problem's name with the problem and its start."""
    pendulum = jc.plants.Pendulum()
    yield "pendulum, 400 steps", jc.tasks.swing_up(pendulum, 4.0), jnp.array([jnp.pi, 0.0])
    for name, arm in (("torque arm", jc.plants.TorqueArm()), ("muscle arm", jc.plants.MuscleArm())):
        problem = jc.tasks.posture(arm, jnp.array([1.0, 1.5]), 0.5)
        yield f"{name}, 50 steps", problem, arm.at_rest(shoulder=1.5, elbow=1.5)


def measure(problem, x0, repetitions=20):
    """Return the solution, the seconds of the first call and those of each warm one."""

    def timed():
        start = time.perf_counter()
        solution = jax.block_until_ready(jc.solve(problem, jc.ILQR(), x0))
        return solution, time.perf_counter() - start

    solution, first = timed()
    return solution, first, [timed()[1] for _ in range(repetitions)]


def main():
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    print(
        f"{'problem':<22}{'cost':>14}{'iterations':>12}{'first [s]':>11}{'warm [ms]':>11}  spread"
    )
    for name, problem, x0 in problems():
        solution, first, warm = measure(problem, x0)
        warm = sorted(1e3 * seconds for seconds in warm)
        print(
            f"{name:<22}{float(solution.cost):>14.6e}{int(solution.num_steps):>12}{first:>11.2f}"
            f"{statistics.median(warm):>11.2f}  {warm[1]:.2f}-{warm[-2]:.2f}"
        )


if __name__ == "__main__":
    main()
