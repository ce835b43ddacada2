"""A frame fixed to a body, a site or the world."""

from __future__ import annotations

from typing import Any, NamedTuple


class Frame(NamedTuple):
    """A frame of a robot: the axes of a body or a site, with the origin at a point of it.

    Functions of a frame, such as `rb.frame_pose` and `rb.jacobian`, accept it in place of `body`.

    Args:
        body: the name of a body, or "world" for the fixed frame.
        point: the origin (3,) in the frame of the body or site, m; zero if None.
        site: the name of a site, instead of a body.

    Example:
        >>> import rbjax as rb
        >>> model, tool = rb.load("arm7"), rb.Frame(site="tool")
        >>> rb.jacobian(model, model.default_state().q, tool).shape
        (6, 7)
    """

    body: Any = None
    point: Any = None
    site: str | None = None
