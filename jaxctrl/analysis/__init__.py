"""Analysis of movements, simulated or measured: arrays in, NumPy arrays and small results out.

Kinematics, peaks of speed and curvature, the two-thirds power law, variability over trials, laws
of speed and accuracy, and recorded movements. Everything is computed on the host and never traced.
Arrays may be NumPy's or JAX's, in SI units; paths are (..., N, 2), times (N,).
"""

from ._kinematics import (
    acceleration as acceleration,
    clearance as clearance,
    curvature as curvature,
    deviation as deviation,
    movement_interval as movement_interval,
    path_distance as path_distance,
    path_length as path_length,
    speed as speed,
    symmetry as symmetry,
    velocity as velocity,
)
from ._peaks import (
    CurvaturePeaks as CurvaturePeaks,
    SpeedProfile as SpeedProfile,
    curvature_peaks as curvature_peaks,
    speed_peaks as speed_peaks,
)
from ._power_law import (
    PowerLaw as PowerLaw,
    PowerLawNull as PowerLawNull,
    least_jerk_exponent as least_jerk_exponent,
    power_law as power_law,
    power_law_null as power_law_null,
)
from ._recorded import load_movements as load_movements, trials as trials
from ._speed_accuracy import (
    SpeedAccuracyFits as SpeedAccuracyFits,
    SpeedAccuracyLaw as SpeedAccuracyLaw,
    effective_width as effective_width,
    fit_speed_accuracy as fit_speed_accuracy,
    index_of_difficulty as index_of_difficulty,
)
from ._variability import (
    Ellipse as Ellipse,
    UncontrolledManifold as UncontrolledManifold,
    endpoint_ellipse as endpoint_ellipse,
    uncontrolled_manifold as uncontrolled_manifold,
)
