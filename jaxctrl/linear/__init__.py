"""Linear-quadratic kernels on plain arrays: Riccati sweeps, with and without bounds."""

from ._box_lqr import box_lqr as box_lqr, pushed as pushed
from ._boxqp import box_qp as box_qp
from ._interior_point import InteriorPoint as InteriorPoint, interior_point as interior_point
from ._riccati import (
    FreeLQR as FreeLQR,
    Sweep as Sweep,
    costates as costates,
    factorise as factorise,
    lqr as lqr,
    lqr_rollout as lqr_rollout,
    solve_factorised as solve_factorised,
)
