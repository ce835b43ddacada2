"""System identification: parameters of a model from measured motion."""

from rbjax.sysid.fit import Fit, Unknown, fit

__all__ = ["Fit", "Unknown", "fit"]
