"""From a robot file to a `Model`, through MuJoCo's own compiler.

Whatever MuJoCo reads, this reads; what the compiled model holds beyond a tree of joints with
springs, dampers and actuators is listed in `model.dropped`.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.arguments import flag
from rbjax.errors import ModelError, UnknownName, UnsupportedFeature, listed
from rbjax.forces.actuators.affine import is_affine, to_columns
from rbjax.loading.complaints import fix_of, sentence
from rbjax.loading.meshes import without_missing_mesh
from rbjax.loading.mjcf import dropped as features
from rbjax.loading.mjcf.actuator_kinds import reflected
from rbjax.loading.mjcf.actuators import actuator_elements, key_states
from rbjax.loading.mjcf.constraints import constraints_of
from rbjax.loading.mjcf.finite import refuse_nan_in, within_range
from rbjax.loading.mjcf.forces import elements
from rbjax.loading.mjcf.geoms import geoms_of
from rbjax.loading.mjcf.names import names_of
from rbjax.loading.motors import with_motors
from rbjax.loading.singular import joints_that_cancel
from rbjax.loading.urdf.inertials import write_inertials
from rbjax.loading.urdf.mimics import Mimics
from rbjax.loading.urdf.reader import read_urdf
from rbjax.loading.urdf.tree import is_urdf
from rbjax.model.model import Bodies, Joints, Keyframes, Model, Sites
from rbjax.model.topology import Topology

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}
_SHOWN = 8  # names listed before "and N more"
_LONG = 300  # characters of a path that a message shows
_ACTIVE = "numbers that no passive joint has, used as the file gives them"
_SCENES = Path(__file__).parent / "scenes"


def scenes() -> tuple[str, ...]:
    """The names of the bundled scenes, for `load`.

    Example:
        >>> import rbjax as rb
        >>> "cart_pole" in rb.scenes()
        True
    """
    return tuple(sorted(p.stem for p in _SCENES.glob("*.xml")))


def load(
    source: Any,
    *,
    floating_base: bool | None = None,
    strict: bool = False,
    limits: bool = False,
    friction: bool = False,
    motors: bool = False,
    constraints: bool = True,
    compliant: bool = False,
) -> Model:
    """A `Model` from an MJCF or URDF file.

    Args:
        source: a path, an XML string, `mujoco.MjSpec`, `mujoco.MjModel`, or a bundled scene's name.
        floating_base: whether a URDF's root link gets a free joint, so that its mass has an effect.
            False and None fix it to the world; None warns if it has a mass.
        strict: raise, instead of warning, if the model leaves out features of the file, or if
            damping, stiffness, armature or friction is negative.
        limits: hold joints within their ranges by compliant stops (`rbjax.forces.JointLimits`).
        motors: add a motor of gear 1, named as the joint, to each hinge and slide without a motor.
        friction: take the file's friction loss of joints as `rbjax.forces.JointFriction`.
        constraints: take the file's connects, welds, joint equalities and mimics as rigid
            constraints (`model.constraints`).
        compliant: let the file's equalities yield as its solref and solimp say, by MuJoCo's law
            (`rbjax.constraints.Soft`); mimics stay rigid.

    Returns:
        The model; `model.dropped` says what was left out. A URDF's inertials are the file's own; a
        warning names links whose inertial no rigid body can have, and joints whose motions cancel.
        A URDF's link 'world' that is not the ground becomes 'world_link'.

    Raises:
        ModelError: the source cannot be read; the message names the file, the cause and the fix.
        UnsupportedFeature: with `strict=True`, the list of what would be left out.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> model.joint_names
        ('shoulder', 'elbow')
    """
    for name, given in (("strict", strict), ("limits", limits), ("friction", friction)):
        flag("load", name, given)
    for name, given in (("motors", motors), ("constraints", constraints), ("compliant", compliant)):
        flag("load", name, given)
    compiled, odd, mimics, lost = _compile_source(
        source, floating_base=bool(floating_base), shapes=None
    )
    if floating_base is False:
        lost = tuple(x for x in lost if not x.startswith(features.FIXED))
    if odd:
        warnings.warn(
            f"{_describe(source)}: inertials that no rigid body has, used as the file gives them: "
            f"{odd}; expected a positive mass, and positive moments none of which exceeds the sum "
            f"of the other two; correct the file if these links matter",
            stacklevel=2,
        )
    taken = {"limits": limits, "friction": friction, "constraints": constraints}
    dropped = features.dropped_features(compiled, **taken) + features.unread_features(compiled)
    if any(x.startswith(features.COLLISION) for x in lost):  # of a URDF, which names the links
        dropped = tuple(x for x in dropped if not x.startswith(features.CONTACTS))
    dropped += lost + mimics.left_out(constraints=constraints)
    active = features.active_numbers(compiled)
    texts = [
        f"{_describe(source)}: {what}: {'; '.join(map(features.cured, entries))}"
        for what, entries in (("left out of the model", dropped), (_ACTIVE, active))
        if entries
    ]
    if texts and strict:
        raise UnsupportedFeature(f"{'. '.join(texts)}. Load with strict=False to get a warning.")
    for text in texts:
        warnings.warn(text, stacklevel=2)
    with jax.ensure_compile_time_eval():  # within jit too, numbers of a file are constants
        model = from_compiled(compiled, dropped, **taken, compliant=compliant)
    if constraints:
        model = model.with_constraints(*mimics.couplings)
    undone = joints_that_cancel(compiled)
    if undone:
        warnings.warn(
            f"{_describe(source)}: joints that together move no mass: {listed(undone, _SHOWN)}; "
            f"the mass matrix is singular and forward dynamics has no finite answer; give one of "
            f"them an armature, or remove one that does what the others do",
            stacklevel=2,
        )
    return with_motors(model) if motors else model


def compile_model(
    source: Any, *, floating_base: bool | None = False, shapes: Collection[str] = ()
) -> mujoco.MjModel:
    """The `mujoco.MjModel` of any source that `load` takes (what `validate` runs beside ours).

    floating_base None: a URDF floats, MJCF is as it is. shapes: links of a URDF that keep theirs.
    """
    return _compile_source(source, floating_base=floating_base, shapes=shapes)[0]


def _compile_source(
    source: Any, *, floating_base: bool | None, shapes: Collection[str] | None = ()
) -> tuple[mujoco.MjModel, str, Mimics, tuple[str, ...]]:
    """The compiled model. Of a URDF also a text about impossible inertials, its mimic joints, and
    its entries of `Model.dropped`. shapes None: the shapes of a URDF that are no meshes."""
    if isinstance(source, mujoco.MjModel):
        return source, "", Mimics(), ()
    name, spec = _describe(source), spec_of(source)
    if spec is not None:
        if floating_base and not isinstance(source, mujoco.MjSpec):
            raise ModelError(
                f"{name}: floating_base=True is for URDF; in MJCF give the root body a <freejoint/>"
            )
        return _compile(spec, name), "", Mimics(), ()
    text, path = _read(source)
    folder, floats = Path() if path is None else path.parent, floating_base is not False
    urdf = read_urdf(text, name, floating_base=floats, shapes=shapes, folder=folder)
    compiled = _compile(urdf.spec, name)
    odd = write_inertials(compiled, urdf.inertials, name)
    return compiled, odd, urdf.mimics, urdf.left_out


def spec_of(source: Any) -> mujoco.MjSpec | None:
    """The spec of an MJCF source; None for a URDF."""
    if isinstance(source, mujoco.MjSpec):
        return source
    if not isinstance(source, (str, Path)):
        raise ModelError(
            f"load: source is {type(source).__name__}, expected a path, an XML string, "
            f"mujoco.MjSpec, mujoco.MjModel or one of the scenes {', '.join(scenes())}"
        )
    text, path = _read(source)
    name = _describe(source)
    if is_urdf(text, name):
        return None
    try:
        read = mujoco.MjSpec
        return read.from_string(text) if path is None else read.from_file(str(path))
    except Exception as error:
        message = sentence(error)
        raise ModelError(f"{name}: MuJoCo cannot parse it: {message}{fix_of(message)}") from error


def _read(source: str | Path) -> tuple[str, Path | None]:
    """The text of a source, and its path where it has one."""
    if isinstance(source, str):
        if source.lstrip().startswith("<"):
            return source, None
        if source in scenes():
            source = _SCENES / f"{source}.xml"
    path = Path(source)
    if not _exists(path):
        if isinstance(source, str) and path.suffix == "":
            raise UnknownName("scene", _describe(source), scenes())
        raise ModelError(f"{_describe(path)}: no such file; give an existing MJCF or URDF path")
    if not path.is_file():  # reading a device or a pipe may never end
        raise ModelError(f"{path}: not a regular file; give an MJCF or URDF file")
    try:
        raw = path.read_bytes()
        declared = re.match(rb"""\s*<\?xml[^>]*\sencoding=["']([\w.-]+)""", raw)
        return raw.decode(declared[1].decode() if declared else "utf-8"), path
    except (UnicodeDecodeError, LookupError, OSError) as error:
        raise ModelError(
            f"{path}: cannot be read as text ({error}); give an MJCF or URDF file"
        ) from error


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, or with a zero in it
        return False


def _describe(source: Any) -> str:
    if isinstance(source, (mujoco.MjModel, mujoco.MjSpec)):
        return type(source).__name__
    text = str(source)
    if text.lstrip().startswith("<"):
        return "XML string"
    return text if len(text) <= _LONG else f"{text[:_LONG]}... ({len(text):,} characters)"


def _compile(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """The compiled spec, without absent meshes that are only seen; the spec stays as it is."""
    while True:
        try:
            return spec.compile()
        except Exception as error:
            message = sentence(error)
            smaller = without_missing_mesh(spec, message)
            if smaller is None:
                raise ModelError(
                    f"{name}: MuJoCo cannot compile it: {message}{fix_of(message)}"
                ) from error
            spec = smaller


def from_compiled(
    m: mujoco.MjModel,
    dropped: tuple[str, ...] = (),
    *,
    limits: bool = False,
    friction: bool = False,
    constraints: bool = True,
    compliant: bool = False,
) -> Model:
    """The `Model` of a compiled MuJoCo model."""
    refuse_nan_in(m)

    def array(x):
        return within_range(np.asarray(x, np.float64))

    off = m.opt.disableflags
    bit = mujoco.mjtDisableBit

    def unless(flag, x):
        return np.zeros_like(x) if off & int(flag) else x

    obj = mujoco.mjtObj
    topology = Topology(
        body_parents=tuple(int(p) - 1 for p in m.body_parentid[1:]),
        joint_kinds=tuple(_KINDS[int(t)] for t in m.jnt_type),
        joint_bodies=tuple(int(b) - 1 for b in m.jnt_bodyid),
        body_names=names_of(m, obj.mjOBJ_BODY, m.nbody)[1:],
        joint_names=names_of(m, obj.mjOBJ_JOINT, m.njnt),
        actuator_names=_control_names(m),
        site_names=names_of(m, obj.mjOBJ_SITE, m.nsite),
        site_bodies=tuple(int(b) - 1 for b in m.site_bodyid),
        keyframe_names=names_of(m, obj.mjOBJ_KEY, m.nkey),
    )
    # MuJoCo computes with frames that coincide within 1e-6 as one frame; so then do we
    same = m.body_sameframe[:, None]
    centre = np.where(same == int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY), 0.0, m.body_ipos)
    aligned = (same == int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY)) | (
        same == int(mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT)
    )
    turn = np.empty((m.nbody, 9))
    for row, quat in zip(turn, np.where(aligned, [1.0, 0, 0, 0], m.body_iquat), strict=True):
        mujoco.mju_quat2Mat(row, quat)
    turn = turn.reshape(-1, 3, 3)
    inertia = np.einsum("bij,bj,bkj->bik", turn, m.body_inertia, turn)
    limited = m.jnt_actfrclimited.astype(bool)[:, None]
    armature, damping, _ = reflected(m)
    ranged = unless(bit.mjDSBL_LIMIT, m.jnt_limited).astype(bool) & ~features.inverted_limits(m)
    ranged = ranged[:, None]
    driven = actuator_elements(m)
    affine = [x for x in driven if is_affine(x)]
    others = [x for x in driven if not is_affine(x)]
    return Model(
        bodies=Bodies(
            mass=array(m.body_mass[1:]),
            com=array(centre[1:]),
            inertia=array(inertia[1:]),
            position=array(m.body_pos[1:]),
            orientation=array(m.body_quat[1:]),
        ),
        joints=Joints(
            placement=array(m.jnt_pos),
            axis=array(m.jnt_axis),
            reference=array(m.qpos0),
            armature=array(m.dof_armature + armature),
            damping=array(unless(bit.mjDSBL_DAMPER, m.dof_damping + damping)),
            stiffness=array(unless(bit.mjDSBL_SPRING, m.jnt_stiffness)),
            springref=array(m.qpos_spring),
            forcerange=array(np.where(limited, m.jnt_actfrcrange, [-np.inf, np.inf])),
            range=array(np.where(ranged, m.jnt_range, [-np.inf, np.inf])),
            params=array(np.zeros(0)),
        ),
        actuators=jax.tree.map(array, to_columns(affine, m.nu)),
        geoms=geoms_of(m, array),
        sites=Sites(position=array(m.site_pos), orientation=array(m.site_quat)),
        keyframes=_keyframes(m, array),
        gravity=array(unless(bit.mjDSBL_GRAVITY, m.opt.gravity)),
        topology=topology,
        timestep=float(m.opt.timestep),
        dropped=tuple(dropped),
        forces=(*elements(m, limits=limits, friction=friction), *others),
        constraints=constraints_of(m, compliant=compliant) if constraints else (),
    )


def _control_names(m: mujoco.MjModel) -> tuple[str, ...]:
    out = [f"control{i}" for i in range(m.nu)]
    for i, (start, count) in enumerate(zip(m.actuator_ctrladr, m.actuator_ctrlnum, strict=True)):
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, i) or f"actuator{i}"
        for k in range(count):
            out[start + k] = name if count == 1 else f"{name}[{k}]"
    return tuple(out)


def _keyframes(m: mujoco.MjModel, array) -> Keyframes:
    states = key_states(m)
    x = array(states) if states.shape[1] else None
    return Keyframes(q=array(m.key_qpos), v=array(m.key_qvel), ctrl=array(m.key_ctrl), x=x)
