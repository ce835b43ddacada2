"""What measured motion says about a robot's numbers."""

from rbjax.sysid.fit import Fit, Unknown, fit

__all__ = ["Fit", "Unknown", "fit"]
