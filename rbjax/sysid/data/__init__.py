"""Recordings of a robot: how they are read, checked, split, filtered and corrected."""

from rbjax.sysid.data.filtering import Filtered, differentiate, low_pass
from rbjax.sysid.data.units import in_si

__all__ = [
    "Filtered", "differentiate", "in_si", "low_pass",
]  # fmt: skip
