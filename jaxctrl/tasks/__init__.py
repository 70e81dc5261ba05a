"""Movement tasks: each function returns a `Problem`; the parts of their costs add with `+`.

Targets, points, times and weights are array leaves: changing one does not recompile.
"""

from ._costs import (
    Effort as Effort,
    HandPath as HandPath,
    HandTarget as HandTarget,
    JointLimits as JointLimits,
    Marks as Marks,
    Obstacle as Obstacle,
    PostureTarget as PostureTarget,
    ViaPoints as ViaPoints,
)
from ._movements import (
    limit_joints as limit_joints,
    posture as posture,
    swing_up as swing_up,
    track as track,
)
from ._reaches import (
    centre_out as centre_out,
    hit as hit,
    obstacle as obstacle,
    reach as reach,
    via as via,
)
