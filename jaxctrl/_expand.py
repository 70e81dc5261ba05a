"""The expansion as users call it."""

from . import _local_model
from ._jit import jit

expand = jit(_local_model.expand)
"""Compiled as a whole: one by one its many operations would each be compiled. Solvers have the
plain function inside their own loops."""
