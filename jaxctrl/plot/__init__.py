"""Plots of movements and of solvers: arrays in, a matplotlib Figure out, nothing computed.

Every function takes NumPy or JAX arrays in SI units and returns a `matplotlib.figure.Figure` in
the one style of the package, made without pyplot: save it with `figure.savefig("reach.pdf")`, or
let a notebook show it. Samples that are not finite leave gaps. With `ax` a function draws into an
existing Axes, such as those of `panels`; in an Axes of another figure it keeps to the settings and
colours found there. `style(dark=True)` makes dark figures.
"""

from ._convergence import convergence
from ._kinematics import power_law, speed_and_curvature
from ._space import hand_paths, joint_paths, phase
from ._style import direction_colours, panels, style
from ._time import activations, controls, speed_profiles, trajectories
from ._workspace import points, workspace_map

__all__ = [
    "activations",
    "controls",
    "convergence",
    "direction_colours",
    "hand_paths",
    "joint_paths",
    "panels",
    "phase",
    "points",
    "power_law",
    "speed_and_curvature",
    "speed_profiles",
    "style",
    "trajectories",
    "workspace_map",
]
