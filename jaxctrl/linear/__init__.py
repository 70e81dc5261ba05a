"""Linear-quadratic kernels on plain arrays: Riccati sweeps, with and without bounds."""

from .._linalg import matmul as matmul, solve_positive as solve_positive
from ._box_lqr import box_lqr as box_lqr
from ._boxqp import box_qp as box_qp
from ._engine import find_engine as find_engine, lqr as lqr
from ._riccati import (
    FreeLQR as FreeLQR,
    Sweep as Sweep,
    costates as costates,
    factorise as factorise,
    lqr_rollout as lqr_rollout,
    solve_factorised as solve_factorised,
)
