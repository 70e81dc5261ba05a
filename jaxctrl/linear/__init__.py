"""Linear-quadratic kernels on plain arrays: Riccati sweeps, and laws with filters."""

from .._linalg import matmul as matmul, solve_positive as solve_positive
from .._types import Noise as Noise, Sensing as Sensing
from ._boxqp import BoxQP as BoxQP
from ._coordinate_descent import ObservedLQG as ObservedLQG
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
from ._moments import AffineLaw as AffineLaw, Moments as Moments
from ._multiplicative_lqg import (
    MultiplicativeLQG as MultiplicativeLQG,
    multiplicative_lqg as multiplicative_lqg,
)
from ._observed_doors import (
    evaluate_observed as evaluate_observed,
    filter_gains as filter_gains,
    observed_law as observed_law,
    observed_lqg as observed_lqg,
    observed_moments as observed_moments,
    sensed_lqg as sensed_lqg,
)
from ._observed_step import ObservedValue as ObservedValue
from ._riccati import Sweep as Sweep
from ._sensed import Errors as Errors, SensedLQG as SensedLQG
from ._step import Value as Value
