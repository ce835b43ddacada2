"""Numbers that no force can have, which MuJoCo compiles."""

from __future__ import annotations

import jax
import numpy as np

from rbjax.errors import ModelError
from rbjax.model.record import Record

#: leaves in which infinite means that there is no limit
_LIMITS = ("range", "limits", "windup", "slew", "drive", "current_rate", "strongest")


def refuse_nan(record: Record) -> None:
    """Refuse a force element of numbers that are not finite."""
    for at, leaf in jax.tree_util.tree_leaves_with_path(record):
        name, values = jax.tree_util.keystr(at).lstrip("."), np.asarray(leaf)
        bad = np.isnan(values) if name.endswith(_LIMITS) else ~np.isfinite(values)
        if bad.any():
            raise ModelError(
                f"the compiled model has {type(record).__name__}.{name} = {values[bad][0]}, which "
                f"is not finite; correct that number in the file"
            )
