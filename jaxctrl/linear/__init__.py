"""Linear-quadratic kernels on plain arrays: Riccati sweeps, with and without bounds."""

from ._box_lqr import box_lqr as box_lqr
from ._boxqp import box_qp as box_qp
from ._riccati import (
    FreeLQR as FreeLQR,
)
from ._riccati import (
    Sweep as Sweep,
)
from ._riccati import (
    costates as costates,
)
from ._riccati import (
    factorise as factorise,
)
from ._riccati import (
    lqr as lqr,
)
from ._riccati import (
    lqr_rollout as lqr_rollout,
)
from ._riccati import (
    solve_factorised as solve_factorised,
)
