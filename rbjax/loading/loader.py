"""`load`: a robot file as a `Model`, through MuJoCo's compiler; motors for files without actuators.

`model.dropped` lists the features of the compiled model that rbjax does not support.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.arguments import flag
from rbjax.constraints import JointPolynomial, Soft
from rbjax.contact.parameters import unstable_contacts
from rbjax.errors import UnsupportedFeature, listed
from rbjax.forces.acting import elements
from rbjax.forces.actuators.actuator import (
    Actuator,
    Affine,
    GainBias,
    from_columns,
    is_affine,
    to_columns,
)
from rbjax.forces.actuators.transmissions import JointAxis, SiteWrench
from rbjax.forces.context import Context
from rbjax.loading.checks import check_finite_fields, joints_that_cancel
from rbjax.loading.mjcf import dropped as features
from rbjax.loading.mjcf.actuators import actuator_elements, key_states
from rbjax.loading.mjcf.constraints import constraints_of, soft_mimic
from rbjax.loading.mjcf.contact_pairs import excluded_bodies, kinds_of
from rbjax.loading.mjcf.contacts import (
    check_finite,
    check_geoms,
    closed_pairs,
    contacts_left_out,
    mixed_references,
)
from rbjax.loading.mjcf.fields import (
    Off,
    inertial_frame,
    is_on,
    leaf,
    matrix_of,
    names_of,
    reflected,
)
from rbjax.loading.mjcf.forces import force_elements
from rbjax.loading.mjcf.sensors import read_sensors
from rbjax.loading.mjcf.solver_parameters import pair_fields, solver_parameters
from rbjax.loading.mjcf.surfaces import surface_fields
from rbjax.loading.mjcf.tendons import limited_tendons, rubbing_tendons, tendon_armature, tendons_of
from rbjax.loading.sources import compile_source, describe
from rbjax.model.components import Bodies, Joints, Keyframes, Sites
from rbjax.model.geoms import Geoms
from rbjax.model.model import Model
from rbjax.model.topology import Topology

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}
_MIXED = "solref of mixed signs, replaced by MuJoCo with (0.02, 1)"
_ACTIVE = "parameters that no passive joint can have, used as in the file"


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
    contacts: bool = True,
) -> Model:
    """Load a `Model` from an MJCF or URDF file.

    Args:
        source: a path, an XML string, `mujoco.MjSpec`, `mujoco.MjModel`, or a bundled scene's name.
        floating_base: whether a URDF's root link gets a free joint, so that its mass has an effect.
            False and None fix it to the world; None warns if it has a mass.
        strict: raise, instead of warning, if features of the file are not supported, or if damping,
            stiffness, armature or friction is negative.
        limits: load the joint limits as compliant stops (`rbjax.forces.JointLimits`).
        friction: load the friction loss of joints as `rbjax.forces.JointFriction`.
        motors: add a motor of gear 1, with the joint's name, to each hinge and slide without one.
        constraints: load connects, welds, joint and tendon equalities and mimics as rigid
            constraints (`model.constraints`).
        compliant: make the equalities compliant by MuJoCo's solref and solimp
            (`rbjax.constraints.Soft`); mimics stay rigid unless the model has a contact law.
        contacts: take the contacts, limits, friction loss and equalities of the file as one
            problem, as MuJoCo does (`model.contact = "mujoco"`). All equalities and mimics are then
            compliant. Limits and friction loss that are loaded as elements are not in it. A robot
            without contacts, limits and friction loss has `model.contact = None` and rigid
            equalities. False: the robot touches nothing. `model.dropped` names the pairs of geoms
            that have no narrow phase.

    Returns:
        The model. `model.dropped` lists the unsupported features. The inertials of a URDF are not
        changed; a warning lists the links with physically impossible inertials, and the joints
        whose motions cancel. A URDF link 'world' that is not the ground is renamed 'world_link'.
        Cables of MuJoCo 3, `<composite type="cable">` and the plugin `mujoco.elasticity.cable`,
        are ball joints with `rbjax.forces.Cable`; MuJoCo 4 does not read them.

    Raises:
        ModelError: the source cannot be read; the message names the file, the cause and the fix.
        UnsupportedFeature: with `strict=True`, the list of unsupported features.

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
    flag("load", "contacts", contacts)
    compiled, odd, mimics, lost = compile_source(
        source, floating_base=bool(floating_base), shapes=None
    )
    if floating_base is False:
        lost = tuple(x for x in lost if not x.startswith(features.FIXED))
    if odd:
        warnings.warn(
            f"{describe(source)}: inertials that no rigid body has, used as the file gives them: "
            f"{odd}; expected a positive mass, and positive moments none of which exceeds the sum "
            f"of the other two; correct the file if these links matter",
            stacklevel=2,
        )
    taken = {"limits": limits, "friction": friction, "constraints": constraints}
    taken["contacts"] = contacts
    dropped = features.dropped_features(compiled, **taken) + features.unread_features(compiled)
    unread = features.COLLISION if contacts else features.MESHES
    lost = tuple(x for x in lost if not x.startswith(unread))
    mixed: tuple[str, ...] = ()
    if contacts:
        check_geoms(compiled)
        check_finite(compiled)
        dropped += contacts_left_out(compiled)
        mixed = mixed_references(compiled)
    if any(x.startswith(features.COLLISION) for x in lost):  # from a URDF, with the link names
        dropped = tuple(x for x in dropped if not x.startswith(features.CONTACTS))
    dropped += lost + mimics.left_out(constraints=constraints)
    active = features.active_numbers(compiled)
    texts = [
        f"{describe(source)}: {what}: {'; '.join(entries)}"
        for what, entries in (
            ("left out of the model", [features.with_cure(x) for x in dropped]),
            (_ACTIVE, active),
            (_MIXED, mixed),
        )
        if entries
    ]
    if texts and strict:
        raise UnsupportedFeature(f"{'. '.join(texts)}. Load with strict=False to get a warning.")
    for text in texts:
        warnings.warn(text, stacklevel=2)
    with jax.ensure_compile_time_eval():  # numbers of a file are constants in jit too
        model = from_compiled(compiled, dropped, **taken, compliant=compliant)
        couplings: tuple[Any, ...] = mimics.couplings if constraints else ()
        if model.contact is not None:
            couplings = tuple(soft_mimic(compiled, one) for one in couplings)
    model = model.with_constraints(*couplings)
    shaken = _unstable(model)
    if shaken:
        warnings.warn(f"{describe(source)}: {shaken} (docs/guides/contacts.md)", stacklevel=2)
    undone = joints_that_cancel(compiled)
    if undone:
        warnings.warn(
            f"{describe(source)}: joints that together move no mass: {listed(undone)}; "
            f"the mass matrix is singular and forward dynamics has no finite answer; give one of "
            f"them an armature, or remove one that does what the others do",
            stacklevel=2,
        )
    return with_motors(model) if motors else model


def _unstable(model: Model) -> str:
    """Return a sentence about contacts that are unstable at the step of a file, or nothing."""
    own = model.solver
    if own is None or model.contact is None or model.geoms is None:
        return ""
    if own.integrator in ("discrete", "rk4"):  # not explicit
        return ""
    return unstable_contacts(model.geoms, float(model.timestep), refsafe=own.refsafe)


def from_compiled(
    m: mujoco.MjModel,
    dropped: tuple[str, ...] = (),
    *,
    limits: bool = False,
    friction: bool = False,
    constraints: bool = True,
    compliant: bool = False,
    contacts: bool = False,
) -> Model:
    """Convert a compiled MuJoCo model to a `Model`."""
    check_finite_fields(m)

    def enabled(flag, x):
        return x if is_on(m, flag) else np.zeros_like(x)

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
    frames = [inertial_frame(m, b) for b in range(m.nbody)]
    centre = np.array([p for p, _ in frames])
    turn = np.array([matrix_of(quat) for _, quat in frames])
    inertia = np.einsum("bij,bj,bkj->bik", turn, m.body_inertia, turn)
    limited = m.jnt_actfrclimited.astype(bool)[:, None]
    armature, damping, _ = reflected(m)
    ranged = enabled(Off.mjDSBL_LIMIT, m.jnt_limited).astype(bool) & ~features.inverted_limits(m)
    ranged = ranged[:, None]
    driven = actuator_elements(m)
    affine = [x for x in driven if is_affine(x)]
    others = [x for x in driven if not is_affine(x)]
    elastic = force_elements(m, limits=limits, friction=friction)
    solver = solver_parameters(m, leaf, limits=not limits, friction=not friction)
    pairs = closed_pairs(m) if contacts else []
    tendons = limited_tendons(m) | rubbing_tendons(m) | (tendon_armature(m) != 0)
    contacts = contacts and bool(pairs or solver.limited or solver.rubbing or tendons.any())
    return Model(
        bodies=Bodies(
            mass=leaf(m.body_mass[1:]),
            com=leaf(centre[1:]),
            inertia=leaf(inertia[1:]),
            position=leaf(m.body_pos[1:]),
            orientation=leaf(m.body_quat[1:]),
        ),
        joints=Joints(
            placement=leaf(m.jnt_pos),
            axis=leaf(m.jnt_axis),
            reference=leaf(m.qpos0),
            armature=leaf(m.dof_armature + armature),
            damping=leaf(enabled(Off.mjDSBL_DAMPER, m.dof_damping + damping)),
            stiffness=leaf(enabled(Off.mjDSBL_SPRING, m.jnt_stiffness)),
            springref=leaf(m.qpos_spring),
            forcerange=leaf(np.where(limited, m.jnt_actfrcrange, [-np.inf, np.inf])),
            range=leaf(np.where(ranged, m.jnt_range, [-np.inf, np.inf])),
            params=leaf(np.zeros(0)),
        ),
        actuators=jax.tree.map(leaf, to_columns(affine, m.nu)),
        geoms=geoms_of(m, leaf, pairs if contacts else None),
        tendons=tendons_of(m, leaf),
        solver=solver,
        contact="mujoco" if contacts else None,
        sites=Sites(position=leaf(m.site_pos), orientation=leaf(m.site_quat)),
        keyframes=_keyframes(m),
        gravity=leaf(enabled(Off.mjDSBL_GRAVITY, m.opt.gravity)),
        topology=topology,
        timestep=float(m.opt.timestep),
        dropped=tuple(dropped),
        forces=(*elastic, *others),
        constraints=constraints_of(m, compliant=compliant or contacts) if constraints else (),
        sensors=read_sensors(m)[0],
    )


def _control_names(m: mujoco.MjModel) -> tuple[str, ...]:
    out = [f"control{i}" for i in range(m.nu)]
    for i, (start, count) in enumerate(zip(m.actuator_ctrladr, m.actuator_ctrlnum, strict=True)):
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, i) or f"actuator{i}"
        for k in range(count):
            out[start + k] = name if count == 1 else f"{name}[{k}]"
    return tuple(out)


def _keyframes(m: mujoco.MjModel) -> Keyframes:
    states = key_states(m)
    x = leaf(states) if states.shape[1] else None
    return Keyframes(q=leaf(m.key_qpos), v=leaf(m.key_qvel), ctrl=leaf(m.key_ctrl), x=x)


def geoms_of(m: mujoco.MjModel, array: Callable, kept: list[int] | None = None) -> Geoms:
    """Read all geoms, in the file's order.

    array: function that makes a leaf of a model. kept: the pairs to read; None for all.
    """

    def static(x: np.ndarray) -> tuple:
        return tuple(x.tolist())

    colors = [m.geom_rgba[i] if k < 0 else m.mat_rgba[k] for i, k in enumerate(m.geom_matid)]
    pairs = pair_fields(m, array, kept)
    return Geoms(
        size=array(m.geom_size),
        position=array(m.geom_pos),
        orientation=array(m.geom_quat),
        friction=array(m.geom_friction),
        solref=array(m.geom_solref),
        solimp=array(m.geom_solimp),
        margin=array(m.geom_margin),
        gap=array(m.geom_gap),
        solmix=array(m.geom_solmix),
        names=names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom),
        types=kinds_of(m),
        bodies=static(m.geom_bodyid - 1),
        contype=static(m.geom_contype),
        conaffinity=static(m.geom_conaffinity),
        condim=static(m.geom_condim),
        priority=static(m.geom_priority),
        group=static(m.geom_group),
        rgba=tuple(tuple(x.tolist()) for x in colors),
        excluded=excluded_bodies(m),
        **pairs,
        **surface_fields(m, pairs["pairs"], array),
    )


_UNLIMITED = np.array([-np.inf, np.inf])


def with_motors(model: Model) -> Model:
    """Add a motor of gear 1 to each hinge and slide without an actuator that is not coupled to
    another joint.

    A motor has its joint's name, with "_motor" appended if an actuator has that name. Its control
    is a torque in N m or a force in N, limited by the joint's force range (a URDF's effort).
    """
    top, keys = model.topology, model.keyframes
    taken = _driven(model) | _followers(model)
    kinds = enumerate(top.joint_kinds)
    free = [j for j, kind in kinds if kind in ("hinge", "slide") and j not in taken]
    names = top.actuator_names
    for j in free:
        name = top.joint_names[j]
        while name in names:
            name += "_motor"
        names = (*names, name)
    motors = [_motor(j, control) for control, j in enumerate(free, model.nu)]
    columns = to_columns((*from_columns(model), *motors), len(names))
    ctrl = jnp.pad(keys.ctrl, ((0, 0), (0, len(free))))
    return dataclasses.replace(
        model,
        actuators=jax.tree.map(lambda x: jnp.asarray(x, model.gravity.dtype), columns),
        topology=dataclasses.replace(top, actuator_names=names),
        keyframes=dataclasses.replace(keys, ctrl=ctrl),
    )


def _motor(joint: int, control: int) -> Actuator:
    one: Any = np.ones(1)
    unit: Any = np.eye(6)[0]
    limits: Any = _UNLIMITED
    law = GainBias(Affine(one), None, None)
    return Actuator(JointAxis(unit, joint), law, limits[None], limits, (control,))


def _driven(model: Model) -> set[int]:
    """Return the joints that an actuator drives by a joint or tendon transmission. A wrench at a
    site does not count."""
    transmissions = [x.transmission for x in elements(model) if isinstance(x, Actuator)]
    context = Context.of(model, 0.0, model.default_state(), None)
    dofs = {
        i for x in transmissions if not isinstance(x, SiteWrench) for i in x.reach(context).arms
    }  # fmt: skip
    return {model.topology.dofs[i].joint for i in dofs}


def _followers(model: Model) -> set[int]:
    """Return the joints that a mimic or a joint equality couples to another joint, or fixes."""
    every = (c.of if isinstance(c, Soft) else c for c in model.constraints)
    return {model.joint(c.joint) for c in every if isinstance(c, JointPolynomial)}
