"""Cables of MJCF, `<composite type="cable">`, as bodies on ball joints.

MuJoCo 3 expands a composite when it reads a file; MuJoCo 4 has no composites. The curve has the
vertices p_0 ... p_n, the segment k has the tangent t_k = (p_k+1 - p_k) / L_k and the axes

    x = t_k,    y = n_k,    z = t_k x n_k

The first normal n_0 is perpendicular to t_0 in the plane of the first two segments. The next ones
follow by the smallest rotation from t_k-1 to t_k, so that the frames do not twist. If the first two
segments are parallel, each frame is the smallest rotation from x to t_k.

As in MuJoCo 3, the vertices are rounded to single precision, and the defaults of the file have no
effect on a composite.

Source: MuJoCo 3, XML reference, body/composite.
"""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.loading.mjcf.fields import quaternion_of

Array = np.ndarray
_PARALLEL = 1e-14  # square of the sine of an angle that MuJoCo takes as zero
_SHAPES = ("capsule", "cylinder", "box")
#: attributes of the elements of a composite
_GEOM = (
    "size", "contype", "conaffinity", "condim", "group", "priority", "friction", "solmix", "solref",
    "solimp", "margin", "gap", "rgba", "mass", "density",
)  # fmt: skip
_JOINT = {
    "group": "group", "stiffness": "stiffness", "damping": "damping", "armature": "armature",
    "margin": "margin", "frictionloss": "frictionloss", "range": "range",
    "solreflimit": "solref_limit", "solimplimit": "solimp_limit",
    "solreffriction": "solref_friction", "solimpfriction": "solimp_friction",
}  # fmt: skip
_SITE = ("size", "group", "rgba")


def add_segments(
    spec: mujoco.MjSpec, first: mujoco._specs.MjsBody, composite: ET.Element, where: str
) -> list[str]:
    """Add the segments of a cable to a spec, and return the names of their bodies. The empty body
    `first` becomes the first segment.
    """
    points = _vertices(composite, where)
    lengths, axes = frames(points)
    n, prefix = len(lengths), composite.get("prefix", "")
    initial = composite.get("initial", "ball")
    labels = ["first", *map(str, range(1, n - 1)), "last"] if n > 1 else ["first"]
    kinds = mujoco.mjtJoint
    body, names = first, [f"{prefix}B_{label}" for label in labels]
    offset = _numbers(composite, "offset", (0.0, 0.0, 0.0), where)
    for k, label in enumerate(labels):
        if k:
            body = body.add_body()
            body.pos, body.quat = [lengths[k - 1], 0, 0], _product(_inverse(axes[k - 1]), axes[k])
        else:
            body.pos, body.quat = offset + points[0], axes[0]
        body.name = names[k]
        _add_geom(body, composite, f"{prefix}G{k}", lengths[k], where)
        if k or initial != "none":
            free = not k and initial == "free"
            joint = _add_joint(body, composite, free, where)
            joint.name, joint.type = (
                f"{prefix}J_{label}",
                kinds.mjJNT_FREE if free else kinds.mjJNT_BALL,
            )
        if k in (0, n - 1):
            _add_site(
                body, composite, f"{prefix}S_{label}", lengths[k] if k == n - 1 else 0.0, where
            )
    for pair in itertools.pairwise(names):
        exclude = spec.add_exclude()
        exclude.bodyname1, exclude.bodyname2 = pair
    return names


def frames(points: Array) -> tuple[Array, list[Array]]:
    """Compute the lengths (n,) and the orientations, quaternions, of the segments of a polygon with
    the vertices (n + 1, 3) in single precision."""
    edges = np.diff(points, axis=0).astype(float)  # the difference is rounded, too
    lengths = np.linalg.norm(edges, axis=-1)
    tangents = edges / lengths[:, None]
    normal, out = np.zeros(3), []
    for k, t in enumerate(tangents):
        if k == 0 and len(tangents) > 1:
            binormal = _unit(np.cross(t, tangents[1]))
            normal = _unit(np.cross(binormal, t))
        elif k:
            before = tangents[k - 1]
            axis = np.cross(before, t)
            angle = math.atan2(_length(axis), before @ t)
            normal = _unit(_rotated(normal, _unit(axis), angle))
        out.append(_orientation(t, normal))
    return lengths, out


def _vertices(composite: ET.Element, where: str) -> Array:
    """Return the vertices (n + 1, 3) of a cable in single precision."""
    given = composite.get("vertex")
    counts = [int(x) for x in _numbers(composite, "count", (1.0,), where)]
    if given is not None:
        points = _numbers(composite, "vertex", (), where).astype(np.float32)
        if len(points) % 3 or counts[0] > 1:
            raise ModelError(
                f"{where}: a cable has {len(points)} numbers in vertex and count {counts[0]}, "
                "expected three numbers per vertex, and no count"
            )
        points = points.reshape(-1, 3)
    else:
        size = np.array([1.0, 0.0, 0.0])
        sizes = _numbers(composite, "size", (), where)[:3]
        size[: len(sizes)] = sizes
        n = counts[0]
        s = np.arange(n) / max(n - 1, 1)
        curves = {
            "s": s * size[0],
            "cos(s)": size[1] * np.cos(np.pi * s * size[2]),
            "sin(s)": size[1] * np.sin(np.pi * s * size[2]),
            "0": 0.0 * s,
        }
        words = composite.get("curve", "").split()
        wrong = [x for x in words if x not in curves]
        if wrong or len(words) > 3 or any(x != 1 for x in counts[1:]):
            raise ModelError(
                f"{where}: a cable has the curve {' '.join(words)!r} and the count {counts}, "
                f"expected at most three of {', '.join(curves)}, and a count in one dimension"
            )
        points = np.stack([curves[x] for x in (*words, "0", "0", "0")[:3]], -1)
        turn = _numbers(composite, "quat", (1.0, 0.0, 0.0, 0.0), where)
        points = np.array([_turned(p, turn) for p in points]).astype(np.float32)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    if len(points) < 2 or not gaps.all():
        raise ModelError(
            f"{where}: a cable has {len(points)} vertices"
            f"{', two of which coincide' if len(points) > 1 else ''}; expected two or more, at "
            "different places: attributes count and size, or vertex"
        )
    return points


def _add_geom(body: Any, composite: ET.Element, name: str, length: float, where: str) -> None:
    own = composite.find("geom")
    own = ET.Element("geom") if own is None else own
    kind = own.get("type", "sphere")  # MuJoCo's default, which no cable can have
    if kind not in _SHAPES:
        raise ModelError(
            f"{where}: the geom of a cable is {kind!r}, expected one of {', '.join(_SHAPES)}"
        )
    geom = _pristine(body.add_geom(), "geom")
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    _set(geom, own, dict(zip(_GEOM, _GEOM, strict=True)), where)
    geom.material = own.get("material", "")
    geom.name = name
    if kind == "box":
        geom.pos = [length / 2, 0, 0]
        geom.size[0] = length / 2
    else:
        geom.fromto = [0, 0, 0, length, 0, 0]


def _add_joint(body: Any, composite: ET.Element, free: bool, where: str) -> Any:
    joint = _pristine(body.add_joint(), "joint")
    joint.group = 3
    for own in composite.findall("joint")[:1]:
        kept = dict(_JOINT)
        for key in ("damping", "armature", "frictionloss") if free else ():
            del kept[key]
        _set(joint, own, kept, where)
    return joint


def _add_site(body: Any, composite: ET.Element, name: str, at: float, where: str) -> None:
    site = _pristine(body.add_site(), "site")
    site.group = 3
    for own in composite.findall("site")[:1]:
        _set(site, own, dict(zip(_SITE, _SITE, strict=True)), where)
        site.material = own.get("material", "")
    site.name, site.pos = name, [at, 0, 0]


def _pristine(element: Any, kind: str) -> Any:
    """Give an element of a spec MuJoCo's built-in values instead of the defaults of the file."""
    world = mujoco.MjSpec().worldbody
    built_in = getattr(world.add_body() if kind == "joint" else world, f"add_{kind}")()
    plain = (np.ndarray, int, float, str)
    for name, attribute in vars(type(element)).items():
        if getattr(attribute, "fset", None) is not None:
            value = getattr(built_in, name)
            if isinstance(value, plain) or hasattr(value, "__members__"):
                setattr(element, name, value)
    return element


def _set(target: Any, source: ET.Element, attributes: dict[str, str], where: str) -> None:
    """Set attributes of an element of a spec from the file. A shorter list keeps the rest."""
    for key, name in attributes.items():
        if key not in source.attrib:
            continue
        given, old = _numbers(source, key, (), where), getattr(target, name)
        if np.ndim(old):
            new = np.array(old, float)
            new[: len(given)] = given
            setattr(target, name, new)
        else:
            setattr(target, name, type(old)(given[0]))


def _numbers(element: ET.Element, name: str, default: Any, where: str) -> Array:
    text = element.get(name)
    if text is None:
        return np.array(default, float)
    try:
        return np.array([float(x) for x in text.split()])
    except ValueError:
        raise ModelError(
            f"{where}: {element.tag} has {name}={text!r}, expected numbers separated by blanks"
        ) from None


# ---------------------------------------------------------------------------- vectors, quaternions


def _length(x: Array) -> float:
    """Return |x|, or zero if MuJoCo takes it as zero."""
    square = float(x @ x)
    return 0.0 if square < _PARALLEL else math.sqrt(square)


def _unit(x: Array) -> Array:
    length = _length(x)
    return x / length if length else x


def _rotated(x: Array, axis: Array, angle: float) -> Array:
    return _turned(x, [math.cos(angle / 2), *(math.sin(angle / 2) * axis)])


def _turned(x: Array, quat: Any) -> Array:
    out = np.empty(3)
    unit = np.array(quat, float)
    mujoco.mju_normalize4(unit)
    mujoco.mju_rotVecQuat(out, np.array(x, float), unit)
    return out


def _inverse(a: Array) -> Array:
    return a * np.array([1.0, -1, -1, -1])


def _product(a: Array, b: Array) -> Array:
    out = np.empty(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


def _orientation(tangent: Array, normal: Array) -> Array:
    """Return the quaternion of the axes x = tangent, y = normal; the smallest rotation from x to
    the tangent if the normal is zero."""
    if not _length(normal):
        x, y, z = tangent
        # for an angle beyond a right angle MuJoCo's rotation is another one, about an axis with z
        quat = np.array([1 + x, 0, -z, y] if x > 0 else [y, z, 0, 1 - x])
        return quat / np.linalg.norm(quat)
    return quaternion_of(np.stack([tangent, normal, np.cross(tangent, normal)], -1))
