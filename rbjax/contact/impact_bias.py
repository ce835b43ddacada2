"""Warning of derivatives through impacts under laws whose force jumps at touch.

The damper of a contact with the impedance d_0 at touch acts at once, with the acceleration

    a = -b d_0 J v,     b = 2 / (d_w T)  or  damping / d_w

The velocity after an impact then depends on the depth of the first step in touch at the rate b d_0,
at each step size. Within a phase of contact the derivatives are right.
"""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np

from rbjax._jax_compat import inside
from rbjax.contact.coulomb import CoulombContact
from rbjax.contact.parameters import pair_parameters
from rbjax.contact.soft import SoftContact
from rbjax.dynamics.tracing.custom_rules import with_jvp
from rbjax.forces.impedance import impedance, stiffness_and_damping
from rbjax.model import Model
from rbjax.model.geoms import Geoms

#: 1/s, the largest rate b d_0 without a warning: the relative error of a slope one second after an
#: impact
LARGEST_RATE = 0.2
#: an impedance that begins near zero
RAMP = "0.0001 0.95 0.02 0.5 2"


def warn_of_impacts(where: str, model: Model, law: Any, *xs: Any, advice: str = "") -> tuple:
    """Return arrays of a motion. Their derivatives warn if the force of a contact jumps at touch.

    where: the function that the warning names. law: the dynamics of the motion. advice: the end of
    the warning.
    """
    if not _is_soft(model, law) or not any(isinstance(x, jax.core.Tracer) for x in xs):
        return xs
    geoms = jax.tree.map(_value, model.geoms)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        if _jump(geoms):
            warnings.warn(
                f"{where}: a derivative of a motion with {type(law).__name__}, whose contacts damp "
                "in full from the first step in touch. If a contact begins within the motion, the "
                f"derivative is biased at any step size. Take geoms with solimp={RAMP!r}, "
                'rb.contact.CompliantContact, contact="impulse" or rb.simulate_impacts '
                f"(docs/guides/contacts.md). If none begins, filter this warning{advice}",
                stacklevel=2,
            )
        return primals[0], tangents[0]

    watched = with_jvp(lambda x: x, rule)  # JAX calls a rule only if the tangent is not zero
    return tuple(watched(x) if isinstance(x, jax.core.Tracer) else x for x in xs)


def jumps_at_touch(model: Model, law: Any) -> bool:
    """Check whether the force of a contact of a model jumps at touch under a law. Parameters with
    unknown values, as in a `jit` with the model as an argument, count as continuous."""
    return _is_soft(model, law) and _jump(jax.tree.map(_value, model.geoms))


def _is_soft(model: Model, law: Any) -> bool:
    return isinstance(law, SoftContact | CoulombContact) and model.geoms is not None


def _jump(geoms: Geoms) -> bool:
    """Check whether the force of a pair jumps at touch. Parameters that are nan are unknown."""
    if not geoms.pairs:
        return False
    found = pair_parameters(geoms, geoms.pairs)
    solref, solimp = found.solref.T, found.solimp.T
    _, damping = stiffness_and_damping(solref, solimp)
    return bool(np.any(impedance(0.0, solimp) * damping > LARGEST_RATE))


def _value(x: Any) -> Any:
    """Return the values of an array, or nan if a traced array has unknown values."""
    found = inside(x)
    known = found is not None and np.shape(found) == np.shape(x)
    return found if known else np.full(np.shape(x), np.nan)
