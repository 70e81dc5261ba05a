"""The expansion as users call it."""

import equinox as eqx

from . import _local_model

expand = eqx.filter_jit(_local_model.expand)
"""Compiled as a whole: one by one its many operations would each be compiled. Solvers have the
plain function inside their own loops."""
