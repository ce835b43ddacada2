"""The base of sensors with one value for each velocity coordinate, and the units of joints."""

from __future__ import annotations

from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns


class JointSensor(Record):
    """A sensor with one value for each velocity coordinate."""

    def columns(self, model: Model) -> Columns:
        return Columns(model.nv)

    def names(self, model: Model) -> tuple[str, ...]:
        """The joint of each value, with an index if the joint has several."""
        return joint_columns(model, velocity=True)


def joint_columns(model: Model, *, velocity: bool) -> tuple[str, ...]:
    """The names of the entries of q, or of v: "joint", or "joint[k]" of a joint with several."""
    names: list[str] = []
    for joint in model.joint_names:
        part = model.v_slice(joint) if velocity else model.q_slice(joint)
        size = part.stop - part.start
        names += [joint] if size == 1 else [f"{joint}[{k}]" for k in range(size)]
    return tuple(names)


def joint_unit(model: Model, turning: str, sliding: str) -> str:
    """The unit of joints that turn, slide, or do either."""
    kinds = set(model.topology.joint_kinds)
    if kinds <= {"hinge", "ball", "universal"}:
        return turning
    return sliding if kinds <= {"slide"} else f"{turning} or {sliding}"
