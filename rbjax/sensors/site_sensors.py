"""The base of sensors with three values at a site."""

from __future__ import annotations

import equinox as eqx

from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns


class SiteSensor(Record):
    """A sensor with three values at a site."""

    site: str = eqx.field(static=True)

    def columns(self, model: Model) -> Columns:
        model.site(self.site)
        return Columns(3)

    def names(self, model: Model) -> tuple[str, ...]:
        """Of the axes."""
        return "x", "y", "z"
