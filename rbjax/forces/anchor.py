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
        if self.body is not None and self.site is not None:
            raise InputError(
                f"Anchor: got body {self.body!r} and site {self.site!r}; give one of them, or none "
                "for the world"
            )
        for kind, name in (("body", self.body), ("site", self.site)):
            if isinstance(name, bool) or not isinstance(name, str | int | None):
                raise InputError(
                    f"Anchor: {kind} is {name!r}, expected its name, its index, or None"
                )

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
        if self.site is not None:
            frame = now.site(self.site)
        else:
            frame = now.body(WORLD if self.body is None else self.body)
        point = table(self.point, now.q.dtype)
        return frame.at(Vec3(*(lane(point, k) for k in range(3))))


def check_anchors(element: Any) -> None:
    """Refuse ends a and b of an element that are no anchors."""
    for end in ("a", "b"):
        got = getattr(element, end)
        if not isinstance(got, Anchor):
            raise InputError(
                f"{type(element).__name__}: {end} is {type(got).__name__}, expected an Anchor: "
                "rbjax.forces.Anchor.on(body=...), on(site=...) or on() for the world"
            )
