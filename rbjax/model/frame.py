"""A frame of a robot, fixed to a body, a site or the world."""

from __future__ import annotations

from typing import Any, NamedTuple


class Frame(NamedTuple):
    """A frame of a robot, as one value: the frame of a body or a site, or a point with its axes.

    Functions of a frame, such as `rb.frame_pose` and `rb.jacobian`, take it in place of `body`.

    Args:
        body: the name of a body; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
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
