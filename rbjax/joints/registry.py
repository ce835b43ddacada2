"""The kinds of joints by name."""

from __future__ import annotations

from rbjax.errors import InputError, UnknownName
from rbjax.joints import lower_pairs as pairs
from rbjax.joints.joint import Joint

_ALL = (
    pairs.Hinge(), pairs.Slide(), pairs.Ball(), pairs.Free(),
    pairs.Screw(), pairs.Cylindrical(), pairs.Planar(), pairs.Universal(),
)  # fmt: skip
_KINDS: dict[str, Joint] = {joint.name: joint for joint in _ALL}
_BUILT_IN = frozenset(_KINDS)


def kinds() -> dict[str, Joint]:
    """Return all kinds of joints, by name.

    Example:
        >>> import rbjax as rb
        >>> rb.joints.kinds()["ball"].nq, rb.joints.kinds()["ball"].nv
        (4, 3)
    """
    return dict(_KINDS)


def kind(name: str) -> Joint:
    """Return a kind of joint, by its name.

    Args:
        name: one of `kinds()`.

    Returns:
        The `Joint`.

    Raises:
        UnknownName: no such kind; the message lists the names.

    Example:
        >>> import rbjax as rb
        >>> dict(rb.joints.kind("screw").params)
        {'pitch': 0.0}
    """
    if not isinstance(name, str) or name not in _KINDS:
        raise UnknownName("joint kind", name, _KINDS)
    return _KINDS[name]


def register(joint: Joint) -> None:
    """Register a kind of joint, for `Model.with_joint` and for `Topology`.

    A class that is defined again, as in a notebook, replaces the earlier class of the same module
    and name.

    Args:
        joint: an instance of a subclass of `Node`, or of `Joint` with its own dofs.

    Raises:
        InputError: `joint` is not a joint, its name is not a string, or its name belongs to a
            built-in kind or to another class.

    See `rbjax.joints.Node` for an example.
    """
    if not isinstance(joint, Joint):
        raise InputError(
            f"register: got {joint!r}, expected an instance of a subclass of rbjax.joints.Node"
        )
    name = getattr(joint, "name", None)
    if not isinstance(name, str) or not name:
        raise InputError(f"register: {type(joint).__name__}.name is {name!r}, expected a string")
    there = _KINDS.get(name)
    if there is not None and (name in _BUILT_IN or _class_of(there) != _class_of(joint)):
        raise InputError(
            f"register: {name!r} is the name of {'.'.join(_class_of(there))} already; "
            "give the new kind another name"
        )
    _KINDS[joint.name] = joint


def dump_kind(joint: Joint) -> tuple[str | Joint, bool]:
    """Return the content of a pickle for a kind of joint: the name of a built-in kind, or the kind,
    and whether it is registered."""
    registered = _KINDS.get(joint.name) is joint
    return joint.name if registered and joint.name in _BUILT_IN else joint, registered


def load_kind(joint: str | Joint, registered: bool) -> Joint:
    """Return a kind of joint from the content of a pickle.

    A kind that was registered is registered again, unless its name and class are registered.
    """
    if isinstance(joint, str):
        return kind(joint)
    if not registered:
        return joint
    there = _KINDS.get(joint.name)
    if there is None or _class_of(there) != _class_of(joint):
        register(joint)
    return kind(joint.name)


def _class_of(joint: Joint) -> tuple[str, str]:
    return type(joint).__module__, type(joint).__qualname__
