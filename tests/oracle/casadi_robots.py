"""The robots of the problem library once more, in CasADi, as `casadi_models` has the arms.

Each is written by its energies and by what its forces do (virtual work), and the equations of
motion follow by Lagrange's equation; the car by the geometry of two axles at a fixed distance.
A step is that of the classical Runge-Kutta rule, with the residual x+ - step(x, u).
"""

import casadi as ca
from casadi_models import Model, lagrange


def runge_kutta(q: ca.SX, dq: ca.SX, u: ca.SX, mass_matrix: ca.SX, force: ca.SX, tip: ca.SX):
    """Discretise M(q) ddq = force by the Runge-Kutta rule; arguments as those of `euler`."""
    x, dt = ca.vertcat(q, dq), ca.SX.sym("dt")
    acceleration = ca.ldl_solve(force, *ca.ldl(mass_matrix))
    rate = ca.Function("rate", [x, u], [ca.cse(ca.vertcat(dq, acceleration))])
    k1 = rate(x, u)
    k2 = rate(x + dt / 2 * k1, u)
    k3 = rate(x + dt / 2 * k2, u)
    k4 = rate(x + dt * k3, u)
    return _explicit(x, u, dt, x + dt * (k1 + 2 * k2 + 2 * k3 + k4) / 6, tip), rate


def _explicit(x: ca.SX, u: ca.SX, dt: ca.SX, step: ca.SX, tip: ca.SX) -> Model:
    after = ca.SX.sym("x_next", x.numel())
    return Model(
        step=ca.Function("step", [x, u, dt], [step]),
        residual=ca.Function("residual", [x, u, after, dt], [after - step]),
        hand=ca.Function("hand", [x], [tip]),
    )


def cart_pole(M=1.0, m=0.2, l=0.5, g=9.81):
    """Return the model of a cart-pole, and its dx/dt(x, u)."""
    q, dq, u = ca.SX.sym("q", 2), ca.SX.sym("dq", 2), ca.SX.sym("u")
    bob = ca.vertcat(q[0] + l * ca.sin(q[1]), -l * ca.cos(q[1]))
    kinetic = 0.5 * M * dq[0] ** 2 + 0.5 * m * ca.sumsqr(ca.jtimes(bob, q, dq))
    H, C = lagrange(q, dq, kinetic)
    weight = -ca.gradient(m * g * bob[1], q)
    return runge_kutta(q, dq, u, H, ca.vertcat(u, 0) + weight - C, bob)


def acrobot(m=(1, 1), l=(1, 1), centre=(1, 1), inertia=(1, 1), friction=(1, 1), g=9.81):
    """Return the model of an acrobot, and its dx/dt(x, u)."""
    q, dq, u = ca.SX.sym("q", 2), ca.SX.sym("dq", 2), ca.SX.sym("u")
    kinetic, potential, joint = 0, 0, ca.SX.zeros(2)
    for i in range(2):
        phi = ca.sum1(q[: i + 1])
        along = ca.vertcat(ca.cos(phi), ca.sin(phi))
        at = joint + centre[i] * along
        kinetic += 0.5 * m[i] * ca.sumsqr(ca.jtimes(at, q, dq))
        kinetic += 0.5 * inertia[i] * ca.jtimes(phi, q, dq) ** 2
        potential += m[i] * g * at[1]
        joint += l[i] * along
    H, C = lagrange(q, dq, kinetic)
    force = ca.vertcat(0, u) - ca.gradient(potential, q) - C - ca.DM(friction) * dq
    return runge_kutta(q, dq, u, H, force, joint)


def planar_quadrotor(m=1.0, l=0.3, inertia=0.2 * 0.3**2, g=9.81):
    """Return the model of a planar quadrotor, and its dx/dt(x, u)."""
    q, dq, u = ca.SX.sym("q", 3), ca.SX.sym("dq", 3), ca.SX.sym("u", 2)
    # The tilt turns the body clockwise: its axes are (cos, -sin) ahead and (sin, cos) upward.
    ahead = ca.vertcat(ca.cos(q[2]), -ca.sin(q[2]))
    upward = ca.vertcat(ca.sin(q[2]), ca.cos(q[2]))
    H, C = lagrange(q, dq, 0.5 * m * ca.sumsqr(dq[:2]) + 0.5 * inertia * dq[2] ** 2)
    force = -ca.gradient(m * g * q[1], q) - C
    for i, place in enumerate((l / 2, -l / 2)):
        rotor = q[:2] + place * ahead
        force += ca.jacobian(rotor, q).T @ (u[i] * upward)
    return runge_kutta(q, dq, u, H, force, q[:2])


def car(d=2.0) -> Model:
    """Return a car whose front wheels roll along a line while its rear axle rolls straight on.

    The rear axle's new place is that on its line at the distance d from the front's.
    """
    x, u, dt = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("dt")
    heading, speed = x[2], x[3]

    def direction(angle):
        return ca.vertcat(ca.cos(angle), ca.sin(angle))

    front = x[:2] + d * direction(heading) + dt * speed * direction(heading + u[0])
    # The root of |front - rear|^2 = d^2 behind the front axle.
    to_front = front - x[:2]
    along = ca.dot(to_front, direction(heading))
    back = along - ca.sqrt(along**2 - ca.sumsqr(to_front) + d**2)
    rear = x[:2] + back * direction(heading)
    turned, ahead = front - rear, direction(heading)
    turn = ca.atan2(ahead[0] * turned[1] - ahead[1] * turned[0], ca.dot(ahead, turned))
    return _explicit(x, u, dt, ca.vertcat(rear, heading + turn, speed + dt * u[1]), x[:2])
