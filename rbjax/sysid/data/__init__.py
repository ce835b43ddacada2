"""Recordings of a robot: readers, checks, splits, filters and units."""

from rbjax.sysid.data.filtering import low_pass
from rbjax.sysid.data.units import in_si

__all__ = [
    "in_si", "low_pass",
]  # fmt: skip

__dir__ = __all__.copy
