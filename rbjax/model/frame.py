"""A frame fixed to a body, a site or the world."""

from __future__ import annotations

from typing import Any, NamedTuple

from rbjax.display import displayed


@displayed
class Frame(NamedTuple):
    """A frame of a robot: the axes of a body, site or geom, with the origin at a point of it.

    Functions of a frame, such as `rb.frame_pose` and `rb.jacobian`, accept it in place of `body`.

    Args:
        body: the name of a body, or "world" for the fixed frame.
        point: the origin (3,) in the frame of the body, site or geom, m; zero if None.
        site: the name of a site, instead of a body.
        geom: the name of a geom, instead of a body.
        center: the name of a body, instead of `body`: the origin is the body's center of mass.
        orientation: the axes of the frame, a quaternion of four floats in the axes of the body,
            site or geom; the same axes if None.

    Example:
        >>> import rbjax as rb
        >>> model, tool = rb.load("arm7"), rb.Frame(site="tool")
        >>> rb.jacobian(model, model.default_state().q, tool).shape
        (6, 7)
    """

    body: Any = None
    point: Any = None
    site: Any = None
    geom: Any = None
    center: Any = None
    orientation: Any = None

    def arguments(self) -> dict[str, Any]:
        """Return the arguments body, point and site of a function of a frame."""
        if self.geom is None and self.center is None and self.orientation is None:
            return {"body": self.body, "point": self.point, "site": self.site}
        axes = None if self.orientation is None else tuple(map(float, self.orientation))
        still = self._replace(point=None, orientation=axes)  # hashable, as a static argument is
        return {"body": still, "point": self.point, "site": None}
