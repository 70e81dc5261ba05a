"""Movement tasks: each function returns a `Problem`; the parts of their costs add with `+`.

Targets, points, times and weights are array leaves: changing one does not recompile.
"""

from ._costs import (
    HandTarget as HandTarget,
)
from ._costs import (
    Obstacle as Obstacle,
)
from ._costs import (
    PostureTarget as PostureTarget,
)
from ._costs import (
    ViaPoints as ViaPoints,
)
from ._movements import (
    centre_out as centre_out,
)
from ._movements import (
    hit as hit,
)
from ._movements import (
    obstacle as obstacle,
)
from ._movements import (
    posture as posture,
)
from ._movements import (
    reach as reach,
)
from ._movements import (
    swing_up as swing_up,
)
from ._movements import (
    via as via,
)
