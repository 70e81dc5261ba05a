"""Linear-quadratic kernels on plain arrays: Riccati sweeps, with and without bounds."""

from .._linalg import matmul as matmul, solve_positive as solve_positive
from ._boxqp import BoxQP as BoxQP
from ._doors import (
    box_lqr as box_lqr,
    box_qp as box_qp,
    costates as costates,
    evaluate as evaluate,
    factorise as factorise,
    lqr as lqr,
    lqr_rollout as lqr_rollout,
    solve_factorised as solve_factorised,
)
from ._factorised import FreeLQR as FreeLQR
from ._riccati import Sweep as Sweep
from ._step import Value as Value
