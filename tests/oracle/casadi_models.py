"""The plants once more, in CasADi and by another road: each from an energy or a length.

Nothing here comes from jaxctrl, the parameters included. Bodies are written by their kinetic
energy, and the equations of motion follow by Lagrange's equation; muscles are written by their
lengths, and moment arms and velocities follow by differentiation (virtual work). One step is that
of the explicit Euler method. With x = (q, dq, a), the residual of a step from x to x+ is

    (q+ - q - dt dq,  M(q) (dq+ - dq) - dt f(q, dq, a, u),  a+ - a - dt da/dt(a, u))

which needs no inverse of M.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np


class Model(NamedTuple):
    """A plant discretised by the Euler method.

    step(x, u, dt) is the next state; residual(x, u, x_next, dt) is zero along a trajectory;
    hand(x) is the hand's position and velocity.
    """

    step: ca.Function
    residual: ca.Function
    hand: ca.Function


def lagrange(q: ca.SX, dq: ca.SX, kinetic: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return M(q) (n, n) and C(q, dq) (n,) of M ddq + C = tau, for a kinetic energy."""
    momentum = ca.gradient(kinetic, dq)
    coriolis = ca.jtimes(momentum, q, dq) - ca.gradient(kinetic, q)
    return ca.jacobian(momentum, dq), coriolis


def euler(
    q: ca.SX,
    dq: ca.SX,
    u: ca.SX,
    mass_matrix: ca.SX,
    force: ca.SX,
    tip: ca.SX,
    activation: tuple[ca.SX, ca.SX] | None = None,
) -> Model:
    """Discretise M(q) ddq = force, and da/dt = rate for activation = (a, rate).

    Arguments: q, dq (n,) and u (nu,) are symbols; tip (2,) is the hand's position as a function
    of q.
    """
    a, rate = (ca.SX(0, 1), ca.SX(0, 1)) if activation is None else activation
    dt = ca.SX.sym("dt")
    x, after = ca.vertcat(q, dq, a), ca.SX.sym("x_next", 2 * q.numel() + a.numel())
    n = q.numel()
    # CasADi's default for symbols, a QR, loses digits by the square of the condition number.
    acceleration = ca.ldl_solve(force, *ca.ldl(mass_matrix))
    step = x + dt * ca.vertcat(dq, acceleration, rate)
    residual = ca.vertcat(
        after[:n] - q - dt * dq,
        mass_matrix @ (after[n : 2 * n] - dq) - dt * force,
        after[2 * n :] - a - dt * rate,
    )
    return Model(
        step=ca.Function("step", [x, u, dt], [step]),
        residual=ca.Function("residual", [x, u, after, dt], [ca.cse(residual)]),
        hand=ca.Function("hand", [x], [tip, ca.jtimes(tip, q, dq)]),
    )


def pendulum(m=1.0, l=1.0, g=9.8, friction=0.01) -> Model:
    """Return an inverted pendulum: x = (angle from upright, rate), u = torque at the pivot."""
    q, dq, u = ca.SX.sym("q"), ca.SX.sym("dq"), ca.SX.sym("u")
    tip = l * ca.vertcat(ca.sin(q), ca.cos(q))
    velocity = ca.jtimes(tip, q, dq)
    M, C = lagrange(q, dq, 0.5 * m * ca.sumsqr(velocity))
    weight = -ca.gradient(m * g * tip[1], q)
    return euler(q, dq, u, M, u + weight - C - friction * dq, tip)


def _arm(q: ca.SX, dq: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return M, C + B dq and the hand of the two-link arm."""
    m2, l1, l2, s2, inertia1, inertia2 = 1.1, 0.30, 0.33, 0.16, 0.025, 0.045
    friction = ca.DM([[0.05, 0.025], [0.025, 0.05]])
    along, forearm = q[0], q[0] + q[1]
    elbow = l1 * ca.vertcat(ca.cos(along), ca.sin(along))
    pointing = ca.vertcat(ca.cos(forearm), ca.sin(forearm))
    # The moments of inertia are about the joints; a body's kinetic energy about a moving point
    # has a term mixed of that point's velocity and of the centre's relative to it.
    at_elbow, about_elbow = ca.jtimes(elbow, q, dq), s2 * ca.jtimes(pointing, q, dq)
    kinetic = 0.5 * inertia1 * dq[0] ** 2 + 0.5 * inertia2 * (dq[0] + dq[1]) ** 2
    kinetic += m2 * (0.5 * ca.sumsqr(at_elbow) + ca.dot(at_elbow, about_elbow))
    M, C = lagrange(q, dq, kinetic)
    return M, C + friction @ dq, elbow + l2 * pointing


def torque_arm() -> Model:
    """Return the two-link arm moved by torques."""
    q, dq, u = ca.SX.sym("q", 2), ca.SX.sym("dq", 2), ca.SX.sym("u", 2)
    M, resistance, hand = _arm(q, dq)
    return euler(q, dq, u, M, u - resistance, hand)


def muscle_arm(active_state: str = "linear") -> Model:
    """Return the two-link arm moved by six muscles with cosine moment arms."""
    q, dq, a, u = (ca.SX.sym(name, n) for name, n in (("q", 2), ("dq", 2), ("a", 6), ("u", 6)))
    M, resistance, hand = _arm(q, dq)
    length = _muscle_lengths(q)
    # Power of a tension T [N] on the muscle is -T dL/dt, and that of its torque is tau'dq.
    metres = length * _optimal_lengths()
    arms = -ca.jacobian(metres, q).T
    peak = 31.8 * np.array([18.0, 14.0, 22.0, 12.0, 5.0, 10.0])
    pull = peak * _tension(active_state, a, length, ca.jtimes(length, q, dq))
    rise = u > a
    rate = (u - a) / ca.if_else(rise, 0.066 + u * (0.050 - 0.066), 0.066)
    return euler(q, dq, u, M, arms @ pull - resistance, hand, (a, rate))


SHORTEST = np.array([0.60, 0.80, 0.70, 0.70, 0.60, 0.85])
LONGEST = np.array([1.10, 1.25, 1.20, 1.10, 1.10, 1.20])
MEAN_ARMS = np.array([[0, 0, 0.040, -0.042, 0.030, -0.039], [0.030, -0.019, 0, 0, 0.032, -0.022]])
COSINE_ARMS = np.array([[0, 0, -0.008, 0, -0.011, 0], [-0.011, 0, 0, 0, -0.010, 0]])
FREQUENCY = 1.9


def _excursions() -> np.ndarray:
    """Integrate the moment arms over both joints from 0 to pi, by Gauss' quadrature; (6,) [m]."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    q = 0.5 * np.pi * (nodes + 1)
    mean_cosine = np.pi * 0.5 * np.sum(weights * np.cos(FREQUENCY * q))
    return (np.pi * MEAN_ARMS + mean_cosine * COSINE_ARMS).sum(axis=0)


def _optimal_lengths() -> np.ndarray:
    """Return L0 [m] of each muscle, so that its range is passed within 0 ... pi; (6,)."""
    return np.abs(_excursions()) / (LONGEST - SHORTEST)


def _muscle_lengths(q: ca.SX) -> ca.SX:
    """Return the muscles' lengths in units of L0, (6,)."""
    wound = MEAN_ARMS.T @ q + COSINE_ARMS.T @ ca.sin(FREQUENCY * q) / FREQUENCY
    start = np.where(_excursions() > 0, LONGEST, SHORTEST)
    return start - wound / _optimal_lengths()


def _active(curve: str, a: ca.SX, l: ca.SX) -> ca.SX:
    """Return the active state for activation and length [L0], elementwise."""
    if curve == "linear":
        return 0.505 * a
    n_f = 2.11 + 4.16 * (1 / l - 1) if curve == "brown" else 2.11
    return 1 - ca.exp(-((ca.fmax(a, 1e-9) / (0.56 * n_f)) ** n_f))


def _tension(curve: str, a: ca.SX, l: ca.SX, v: ca.SX) -> ca.SX:
    """Return T/F0 for activation, length [L0] and velocity [L0/s], elementwise."""
    active = _active(curve, a, l)
    by_length = ca.exp(-(ca.fabs((l**1.93 - 1) / 1.03) ** 1.87))
    shortening = (5.72 + v) / (5.72 - (1.38 + 2.09 * l) * v)
    lengthening = (0.62 - v * (-3.12 + 4.21 * l - 2.67 * l**2)) / (0.62 + v)
    by_velocity = ca.if_else(v <= 0, shortening, lengthening)
    passive = -0.02 * ca.exp(13.8 - 18.7 * l)
    return active * (by_length * by_velocity + passive)


def chain(n: int, friction: float = 0.05) -> Model:
    """Return n thin rods, 0.63 m and 2.4 kg together, by the Jacobians of their centres."""
    l, m = 0.63 / n, 2.4 / n
    q, dq, u = (ca.SX.sym(name, n) for name in ("q", "dq", "u"))
    joint = ca.SX.zeros(2)
    M = ca.SX.zeros(n, n)
    for i in range(n):
        phi = ca.sum1(q[: i + 1])
        rod = l * ca.vertcat(ca.cos(phi), ca.sin(phi))
        linear = ca.jacobian(joint + 0.5 * rod, q)
        angular = ca.jacobian(phi, q)
        M += m * (linear.T @ linear + l**2 / 12 * angular.T @ angular)
        joint += rod
    M, C = lagrange(q, dq, 0.5 * ca.dot(dq, M @ dq))
    return euler(q, dq, u, M, u - C - friction * dq, joint)
