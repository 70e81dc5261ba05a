"""The problems on which solvers are timed, each with its start and its random starts.

They are written anew here, small and self-contained, so that other programs can state the very
same ones: explicit Euler, J = sum_i w_i (x_N - x*)_i^2 / 2 + sum_k dt r |u_k|^2 / 2.

- P1: a pendulum swings up, 400 steps of 10 ms.
- P2: a torque-driven two-link arm, 100 steps of 5 ms.
- P3: the same arm driven by six muscles with constant moment arms, 0 <= u <= 1.
- P3h: a faster and longer movement of it, where the bounds bind hard; P3f: P3 without bounds.
- P4-n: a chain of n links, 50 steps of 10 ms.

The muscle arm is a benchmark, not the package's `MuscleArm`: its curves are smoothed, so that all
solvers see the same twice differentiable function.
"""

import jax.numpy as jnp
import numpy as np

import jaxctrl as jc

MUSCLES = ("SF", "SX", "EF", "EX", "BF", "BX")
ARMS = np.array([[4, -4, 0, 0, 2.8, -3.5], [0, 0, 2.5, -2.5, 2.8, -3]]) * 1e-2
PCSA = np.array([18.0, 22, 14, 18, 10, 12])
OPTIMAL_LENGTH = np.array([16.0, 16, 10, 10, 20, 22]) * 1e-2
REFERENCE = np.array([0.8, 1.35])
PEAK_FORCE = 31.8 * PCSA


def accelerations(xp, q, dq, torque):
    """Return the two-link arm's angular accelerations as a pair; `xp` is NumPy or jax.numpy."""
    m2, l1, s2, upper, fore = 1.0, 0.30, 0.16, 0.025, 0.045
    d1, d2, d3 = upper + fore + m2 * l1**2, m2 * l1 * s2, fore
    c, s = xp.cos(q[1]), xp.sin(q[1])
    m11, m12, m22 = d1 + 2 * d2 * c, d3 + d2 * c, d3
    n1 = torque[0] + d2 * s * dq[1] * (2 * dq[0] + dq[1]) - 0.05 * dq[0] - 0.025 * dq[1]
    n2 = torque[1] - d2 * s * dq[0] ** 2 - 0.025 * dq[0] - 0.05 * dq[1]
    determinant = m11 * m22 - m12 * m12
    return (m22 * n1 - m12 * n2) / determinant, (m11 * n2 - m12 * n1) / determinant


def tension(xp, a, l, v):
    """Return the smoothed tension T/F0 of each muscle."""
    a = xp.maximum(a, 1e-6)
    exponent = 2.11 + 4.16 * (1 / l - 1)
    active = 1 - xp.exp(-xp.exp(exponent * xp.log(a / (0.56 * exponent))))
    z = (xp.exp(1.93 * xp.log(l)) - 1) / 1.03
    force_length = xp.exp(-xp.exp(0.935 * xp.log(z * z + 1e-6)))
    slow, fast = xp.minimum(v, 0.0), xp.maximum(v, 0.0)
    shortening = (-5.72 - slow) / (-5.72 + (1.38 + 2.09 * l) * slow)
    lengthening = (0.62 - (-3.12 + 4.21 * l - 2.67 * l * l) * fast) / (0.62 + fast)
    force_velocity = xp.where(v > 0, lengthening, shortening)
    return active * (force_length * force_velocity - 0.02 * xp.exp(13.8 - 18.7 * l))


def pendulum(xp, x, u):
    """Return dx/dt of the pendulum."""
    return xp.stack([x[1], 9.8 * xp.sin(x[0]) - 0.01 * x[1] + u[0]])


def torque_arm(xp, x, u):
    """Return dx/dt of the torque arm."""
    return xp.stack([x[2], x[3], *accelerations(xp, x[:2], x[2:], u)])


def muscle_arm(xp, x, u):
    """Return dx/dt of the muscle arm."""
    q, dq, a = x[:2], x[2:4], x[4:]
    bend = q - REFERENCE
    raw = 1 - (ARMS[0] * bend[0] + ARMS[1] * bend[1]) / OPTIMAL_LENGTH
    l = 1 + 0.25 * xp.tanh((raw - 1) / 0.25)
    v = -(ARMS[0] * dq[0] + ARMS[1] * dq[1]) / OPTIMAL_LENGTH
    force = PEAK_FORCE * tension(xp, a, l, v)
    torque = (xp.sum(ARMS[0] * force), xp.sum(ARMS[1] * force))
    time = xp.where(u > a, 0.066 - 0.016 * u, 0.066)
    return xp.concatenate([dq, xp.stack([*accelerations(xp, q, dq, torque)]), (u - a) / time])


def chain(n):
    """Return dx/dt of a chain of n links with point masses at their tips, in absolute angles.

    M_ij = c_max(i,j) l^2 cos(p_i - p_j), with c_i the mass from link i to the tip; the joints'
    damping acts on relative rates.
    """
    mass, length, damping = 2 / n, 1 / n, 0.005
    beyond = mass * (n - np.arange(n))
    heavier = beyond[np.maximum.outer(np.arange(n), np.arange(n))] * length**2

    def dynamics(xp, x, u):
        p, w = x[:n], x[n:]
        difference = p[:, None] - p[None, :]
        relative = w - xp.concatenate([xp.zeros(1), w[:-1]])
        joint = u - damping * relative
        net = joint - xp.concatenate([joint[1:], xp.zeros(1)])
        net = net - (heavier * xp.sin(difference) * (w * w)[None, :]).sum(1)
        M = heavier * xp.cos(difference)
        if xp is np:
            return np.concatenate([w, np.linalg.solve(M, net)])
        return jnp.concatenate([w, jc.linear.solve_positive(M, net[:, None])[0][:, 0]])

    return dynamics


class Case:
    """One problem: its numbers, its dynamics for any array library, and starts for it."""

    def __init__(self, dynamics, nx, nu, T, dt, r, w, target, x0, start, bounds=None, best=None):
        self.dynamics, self.nx, self.nu, self.T, self.dt, self.r = dynamics, nx, nu, T, dt, r
        self.w, self.target, self.x0 = (np.asarray(a, float) for a in (w, target, x0))
        self.start = np.full((T, nu), float(start))
        self.bounds, self.best = bounds, best

    def problem(self):
        """Return it as a `Problem`."""
        plant = jc.FunctionPlant(
            lambda x, u, t: self.dynamics(jnp, x, u), nx=self.nx, nu=self.nu,
            control_bounds=self.bounds,
        )  # fmt: skip
        cost = jc.QuadraticCost(R=self.r, Qf=self.w, target=self.target)
        return jc.Problem(plant, cost, num_steps=self.T, dt=self.dt)

    def cost(self, us):
        """Return the cost of controls (T, nu) from a plain NumPy roll-out: the one judge of all."""
        us = np.asarray(us, float)
        if self.bounds is not None and not ((us >= -1e-9) & (us <= 1 + 1e-9)).all():
            return np.inf
        x = self.x0
        for u in us:
            x = x + self.dt * self.dynamics(np, x, u)
        return 0.5 * np.sum(self.w * (x - self.target) ** 2) + 0.5 * self.dt * self.r * np.sum(
            us**2
        )

    def starts(self, name, count=100):
        """Return random controls (count, T, nu): a constant level with noise on it.

        Without bounds their standard deviation is 5 (P1), 2 (P2) or 1, half of the variance each.
        The choice matters: with as much in both parts alone, a tenth of the starts of P1 and P2
        ends in optima that wind around more often, from feasible starts with Crocoddyl too.
        """
        rng = np.random.default_rng(0)
        shape = (count, self.T, self.nu)
        if self.bounds is None:
            sd = {"P1": 5.0, "P2": 2.0}.get(name, 1.0)
            level, noise = rng.standard_normal((count, 1, self.nu)), rng.standard_normal(shape)
            return sd * np.sqrt(0.5) * (level + noise)
        level = rng.uniform(0.02, 0.4, (count, 1, self.nu))
        return np.clip(level + 0.03 * rng.standard_normal(shape), 0.0, 1.0)


def cases(links=(4, 8)):
    """Return all cases by name."""
    reach, angles = [1.0, 1.0, 0.0, 0.0], [0.5, 1.0, 0.0, 0.0]
    rest, still = [0.05] * 6, [0.0] * 6

    def muscles(T, dt, w, target, bounds, best):
        return Case(
            muscle_arm, 10, 6, T, dt, 1e-4, [*w, *still], [*target, 0, 0, *still],
            [*angles, *rest], 0.1, bounds, best,
        )  # fmt: skip

    found = {
        "P1": Case(
            pendulum, 2, 1, 400, 0.01, 1e-5, [1, 1], [0, 0], [np.pi, 0], 0, best=1.149962e-4
        ),
        "P2": Case(
            torque_arm, 4, 2, 100, 0.005, 1e-4, reach, [1, 1.5, 0, 0], angles, 0, best=2.358554e-5
        ),
        "P3f": muscles(100, 0.005, reach, [1, 1.5], None, None),
        "P3": muscles(100, 0.005, reach, [1, 1.5], (0.0, 1.0), 1.749888e-6),
        "P3h": muscles(100, 0.0025, [1, 1, 0.01, 0.01], [1.2, 1.8], (0.0, 1.0), 2.62744e-5),
    }
    for n in links:
        relative = np.full(n, 0.3)
        relative[0] = 0.2
        bent, zeros = np.cumsum(relative), np.zeros(n)
        target = bent + 0.4 / np.sqrt(n)
        found[f"P4-{n}"] = Case(
            chain(n), 2 * n, n, 50, 0.01, 1e-4, [*(zeros + 1), *zeros], [*target, *zeros],
            [*bent, *zeros], 0,
        )  # fmt: skip
    return found
