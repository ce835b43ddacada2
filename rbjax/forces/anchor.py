"""Where a force takes hold: a point of a body, of a site's frame, or of the world."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.forces.instant import Frame, Instant
from rbjax.lanes import Vec3
from rbjax.model import WORLD
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.model import Record


class Anchor(Record):
    """A point of a body, of a site's frame, or of the world if neither is named.

    Fields: point (3,) m, in the axes of the frame. Static: `body`, `site`, its name or index.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rb.forces.Anchor.on(body="trunk", point=[0.1, 0.0, 0.0]).body
        'trunk'
    """

    point: jax.Array
    body: str | int | None = eqx.field(static=True, default=None)
    site: str | int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_named(self)

    @classmethod
    def on(
        cls,
        *,
        body: str | int | None = None,
        site: str | int | None = None,
        point: jax.typing.ArrayLike | list[float] = (0.0, 0.0, 0.0),  # type: ignore[assignment]
    ) -> Anchor:
        """The anchor at a point, at the origin of the frame if none is given."""
        return cls(check_array("Anchor.on", "point", point, (3,)).astype(float), body, site)

    def frame(self, now: Instant) -> Frame:
        """Its frame at an instant."""
        frame = named_frame(self, now)
        point = table(self.point, now.q.dtype)
        return frame.at(Vec3(*(lane(point, k) for k in range(3))))


def check_named(place: Any) -> None:
    """Refuse a `body` and a `site` that name no frame, or two."""
    kind = type(place).__name__
    if place.body is not None and place.site is not None:
        raise InputError(
            f"{kind}: got body {place.body!r} and site {place.site!r}; give one of them, or none "
            "for the world"
        )
    for what, name in (("body", place.body), ("site", place.site)):
        if isinstance(name, bool) or not isinstance(name, str | int | None):
            raise InputError(f"{kind}: {what} is {name!r}, expected its name, its index, or None")


def named_frame(place: Any, now: Instant) -> Frame:
    """The frame of the body or the site that it names; of the world if none."""
    if place.site is not None:
        return now.site(place.site)
    return now.body(WORLD if place.body is None else place.body)


def check_anchors(element: Any) -> None:
    """Refuse ends a and b of an element that are no anchors."""
    for end in ("a", "b"):
        got = getattr(element, end)
        if not isinstance(got, Anchor):
            raise InputError(
                f"{type(element).__name__}: {end} is {type(got).__name__}, expected an Anchor: "
                "rbjax.forces.Anchor.on(body=...), on(site=...) or on() for the world"
            )
