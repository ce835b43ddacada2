"""Base classes of sensors: a fixed number of values, one value per dof, or a frame of a robot."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Hashable, Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, shown
from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context, FrameState
from rbjax.lanes import Lane, pack
from rbjax.model import Frame, Model
from rbjax.model.leaves import frame_transform
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns

#: names of the entries of a vector and of a quaternion
AXES, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


def reading(context: Context, lanes: Iterable[Lane]) -> jax.Array:
    """Stack lanes as a reading (n,) in the dtype of q."""
    lanes = list(lanes)
    return pack(lanes, jnp.zeros(len(lanes), context.q.dtype))


def check_data(where: str, kind: str, data: Any, known: Collection[str]) -> None:
    """Raise unless `data` is a tuple of some of the known names. kind: of a name, for messages."""
    if isinstance(data, str) or not data:
        raise InputError(f"{where}: data is {data!r}, expected a tuple of some of {list(known)}")
    for part in data:
        choice(kind, part, known)


class FixedSensor(Record):
    """Base class of a sensor with a fixed number of values.

    labels: names of the values; static.
    of: the SI unit; static.
    attitudes: first column of each quaternion; static.
    clipped: how a cutoff limits the values: "both" sides, "above", or "" for unit vectors and
        quaternions, which have no cutoff; static.
    """

    labels: ClassVar[tuple[str, ...]] = ("value",)
    of: ClassVar[str] = "1"
    attitudes: ClassVar[tuple[int, ...]] = ()
    clipped: ClassVar[str] = "both"

    def __check_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.metadata.get("static", False) and not isinstance(value, Hashable | list):
                raise InputError(
                    f"{type(self).__name__}: {field.name} is {shown(value)}, expected a name or "
                    "numbers that do not change, such as a tuple"
                )

    def columns(self, model: Model) -> Columns:
        self.check(model)
        return Columns(len(self.labels), self.attitudes)

    def check(self, model: Model) -> None:
        """Raise UnknownName if the model has no such joint, frame or geom."""

    def names(self, model: Model) -> tuple[str, ...]:
        """List the names of the values."""
        return self.labels

    def unit(self, model: Model) -> str:
        return self.of


class FrameSensor(FixedSensor):
    """Base class of a sensor at a frame.

    frame: an `rb.Frame`, or the name of a site, or of a body if no site has the name, or the index
        of a site; static.
    """

    labels: ClassVar[tuple[str, ...]] = AXES
    frame: Any = eqx.field(static=True)

    def check(self, model: Model) -> None:
        frame_transform(model, named_frame(model, self.frame), jnp.result_type(float))

    def at(self, context: Context) -> FrameState:
        """Return the frame of the sensor at an instant."""
        return context.frame(named_frame(context.model, self.frame))


def named_frame(model: Model, place: Any, *, body_first: bool = False) -> Frame:
    """Return the `rb.Frame` of a site or body, from its name or an index of a site.

    If a site and a body have the name, it is the site's unless `body_first` is set.
    """
    if isinstance(place, Frame):
        return place
    if isinstance(place, str):
        kinds = [("site", model.site_names), ("body", (*model.body_names, "world"))]
        for kind, names in reversed(kinds) if body_first else kinds:
            if place in names:
                return Frame(**{kind: place})
        known = [*model.site_names, *model.body_names]
        raise UnknownName("body or site" if body_first else "site or body", place, known)
    if isinstance(place, int) and not isinstance(place, bool):
        return Frame(site=model.site(place))
    raise InputError(
        f"a frame is {type(place).__name__}, expected rb.Frame(...) or the name of a site or body"
    )
