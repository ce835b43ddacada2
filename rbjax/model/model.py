"""Model and State: a robot as a pytree.

Static fields, such as `Topology`, determine the compiled program. Leaves are its inputs: masses,
gains and gravity can be differentiated, and changed without recompilation.
"""

from __future__ import annotations

import math
import numbers
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import FLOATS, choice
from rbjax.errors import InputError, ModelError
from rbjax.model.acting_twice import with_warning
from rbjax.model.cells import known_entries, with_fixed_entries
from rbjax.model.components import Actuators, Bodies, Joints, Keyframes, Sites
from rbjax.model.geoms import Geoms, check_bodies
from rbjax.model.model_table import model_display
from rbjax.model.random_state import random_coordinates
from rbjax.model.record import (
    CONTACT_NAMES,
    EXECUTION,
    PRECOMPUTED_FROM,
    Execution,
    cast_floats,
    index_of,
)
from rbjax.model.record import DRIVER_NAMES as DRIVER_NAMES
from rbjax.model.record import Record as Record
from rbjax.model.solver_parameters import SolverParameters
from rbjax.model.state import State
from rbjax.model.tendons import Tendons
from rbjax.model.topology import Topology
from rbjax.model.with_joint import with_joint
from rbjax.model.with_link import with_link

#: the classes of the fields that are records; those of `OPTIONAL` may be None
RECORDS = {
    "bodies": Bodies, "joints": Joints, "actuators": Actuators, "sites": Sites,
    "keyframes": Keyframes, "topology": Topology, "execution": Execution, "geoms": Geoms,
    "tendons": Tendons, "solver": SolverParameters,
}  # fmt: skip
OPTIONAL = ("geoms", "tendons", "solver")
#: the classes, for messages, and a method of the entries of the fields that are tuples
TUPLES = {
    "forces": ("rbjax.forces.Element", "loads"),
    "constraints": ("rbjax.constraints.Constraint", "rows"),
    "sensors": ("rbjax.sensors.NamedSensor", "columns"),
}
#: the number of axes of each leaf of one model, in the order of the leaves
AXES = {
    "bodies.mass": 1, "bodies.com": 2, "bodies.inertia": 3, "bodies.position": 2,
    "bodies.orientation": 2, "joints.placement": 2, "joints.axis": 2, "joints.reference": 1,
    "joints.armature": 1, "joints.damping": 1, "joints.stiffness": 1, "joints.springref": 1,
    "joints.forcerange": 2, "joints.range": 2, "joints.params": 1,
    "actuators.gear": 2, "actuators.gain": 2, "actuators.bias": 2, "actuators.ctrlrange": 2,
    "actuators.forcerange": 2, "gravity": 1,
}  # fmt: skip
_AXES = list(AXES.values())


class Model(Record):
    """A robot, as a pytree. `rb.load` makes it from a file.

    Fields:
        bodies, joints, actuators, sites, keyframes: the parts, as arrays in SI units.
        gravity: (3,), m/s^2.
        topology: static, the tree: parents, kinds of joints, names.
        timestep: static, the step of the file, s.
        dropped: static, what was left out of the file.
        execution: options that do not change results, such as the driver of the recursions.
        forces: force elements (`rbjax.forces.Element`), without joint springs and actuators.
        constraints: constraints on the motion (`rbjax.constraints.Constraint`).
        geoms, tendons, solver: None if the model has none.
        contact: static, the contact law: a name of `rb.contact.laws()`, a law with arguments, or
            None for no contact.
        sensors: `rbjax.sensors.NamedSensor`s, read by `rb.sense`.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> model.nq, model.nv, model.nb
        (1, 1, 1)
        >>> heavier = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
    """

    bodies: Bodies
    joints: Joints
    actuators: Actuators
    sites: Sites
    keyframes: Keyframes
    gravity: jax.Array
    topology: Topology = eqx.field(static=True)
    timestep: float = eqx.field(static=True)
    dropped: tuple[str, ...] = eqx.field(static=True)
    execution: Execution = Execution()
    forces: tuple = ()
    constraints: tuple = ()
    geoms: Geoms | None = None
    tendons: Tendons | None = None
    solver: SolverParameters | None = None
    contact: str | None = eqx.field(static=True, default=None)
    sensors: tuple = ()

    def __check_init__(self) -> None:
        real = isinstance(self.timestep, numbers.Real)
        if not (real and 0 < self.timestep < math.inf):
            raise ModelError(
                f"timestep is {self.timestep!r}, expected a positive number of seconds: "
                "correct <option timestep/> in the file, or model.replace(timestep=0.002); "
                "a step that is an array is for rollout(dt=...)"
            )

    def replace(self, **changes: Any) -> Model:
        """Return a copy with the given fields, or fields of `execution`, changed.

        Arrays must keep their shapes. Entries that `fix_zeros` has fixed keep their values.

        Raises:
            UnknownName: no such field. InputError: a value of another class, shape or dtype.
        """
        changes = {name: _checked_part(name, value) for name, value in changes.items()}
        check_bodies(changes.get("geoms"), changes.get("topology", self.topology).nb)
        how = {name: changes.pop(name) for name in EXECUTION if name in changes}
        if changes.keys() & PRECOMPUTED_FROM or "zeros" in how:
            how = {"constants": None, "weights": None} | how
        elif "constraints" in changes:
            how = {"weights": None} | how
        zeros = how.get("zeros", self.execution.zeros)
        if zeros is not None:
            changes |= with_fixed_entries(changes, dict(zeros))
        if how:
            changes["execution"] = changes.get("execution", self.execution).replace(**how)
        return super().replace(**changes)

    _display_ = model_display

    @property
    def driver(self) -> str:
        """The name of the driver of the recursions: one of `DRIVER_NAMES`."""
        return self.execution.driver

    def several(self) -> tuple[str, tuple[int, ...], int] | None:
        """Return (name, shape, expected number of axes) of a leaf with a batch axis, or None."""
        leaves = jax.tree.leaves((self.bodies, self.joints, self.actuators, self.gravity))
        if [getattr(x, "ndim", 0) for x in leaves] == _AXES:
            return None
        found = zip(AXES.items(), leaves, strict=False)
        wrong = ((name, np.shape(x), n) for (name, n), x in found if np.ndim(x) != n)
        return next(wrong, None)

    @property
    def nq(self) -> int:
        """The number of configuration coordinates."""
        return self.topology.nq

    @property
    def nv(self) -> int:
        """The number of velocity coordinates."""
        return self.topology.nv

    @property
    def nu(self) -> int:
        """The number of controls."""
        return len(self.topology.actuator_names)

    @property
    def nx(self) -> int:
        """The number of states of the force elements."""
        return sum(element.size for element in self.forces)

    @property
    def nb(self) -> int:
        """The number of bodies, without the world."""
        return self.topology.nb

    @property
    def body_names(self) -> tuple[str, ...]:
        return self.topology.body_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.topology.joint_names

    @property
    def actuator_names(self) -> tuple[str, ...]:
        return self.topology.actuator_names

    @property
    def site_names(self) -> tuple[str, ...]:
        return self.topology.site_names

    @property
    def keyframe_names(self) -> tuple[str, ...]:
        return self.topology.keyframe_names

    @property
    def tendon_names(self) -> tuple[str, ...]:
        return () if self.tendons is None else self.tendons.names

    def body(self, name: str | int) -> int:
        """Return the index of a body from its name. An index is checked and returned."""
        return index_of("body", name, self.body_names)

    def joint(self, name: str | int) -> int:
        """Return the index of a joint from its name. An index is checked and returned."""
        return index_of("joint", name, self.joint_names)

    def q_slice(self, joint: str) -> slice:
        """Return the slice of a joint's coordinates in q: 7 if free, 4 of a ball, 1 of a hinge.

        Example:
            >>> import rbjax as rb
            >>> model = rb.load("cart_pole")
            >>> model.q_slice(model.joint_names[1])
            slice(1, 2, None)
        """
        i, top = self.joint(joint), self.topology
        return slice(top.joint_q[i], top.joint_q[i] + top.joints[i].nq)

    def v_slice(self, joint: str) -> slice:
        """Return the slice of a joint's coordinates in v: 6 if free, 3 of a ball, 1 of a hinge."""
        i, top = self.joint(joint), self.topology
        return slice(top.joint_v[i], top.joint_v[i] + top.joints[i].nv)

    def actuator(self, name: str | int) -> int:
        """Return the index of an actuator from its name, which is the index of its control."""
        return index_of("actuator", name, self.actuator_names)

    def site(self, name: str | int) -> int:
        """Return the index of a site from its name."""
        return index_of("site", name, self.site_names)

    def tendon(self, name: str | int) -> int:
        """Return the index of a tendon from its name."""
        return index_of("tendon", name, self.tendon_names)

    def geom(self, name: str | int) -> int:
        """Return the index of a geom from its name."""
        return index_of("geom", name, () if self.geoms is None else self.geoms.names)

    def fix_zeros(self) -> Model:
        """Return a copy in which zeros of bodies, joints and gravity are compile-time constants.

        Use it for a batch of robots that differ in masses and lengths: the leaves stay inputs of
        the compiled program, but their zeros cost no arithmetic. Ones of axes and orientations are
        fixed in addition. `replace` keeps the value of a fixed entry, and its derivative is zero.
        """
        return self.replace(zeros=known_entries(self))

    def astype(self, dtype: Any) -> Model:
        """Convert the floating-point leaves of the model.

        Algorithms compute in the dtype of q and v. The states of a model have its own dtype.

        Raises:
            InputError: the dtype is neither float32 nor float64.

        Example:
            >>> import rbjax as rb, jax.numpy as jnp
            >>> rb.load("pendulum").astype(jnp.float32).default_state().q.dtype
            dtype('float32')
        """
        try:
            floating = dtype is not None and np.dtype(dtype) in FLOATS
        except TypeError:  # not a dtype
            floating = False
        if not floating:
            raise InputError(f"Model.astype: got {dtype}, expected float32 or float64")

        return cast_floats(self.replace(constants=None, weights=None), dtype)

    def default_state(self) -> State:
        """Return the state at rest at the reference configuration, qpos0 of MJCF."""
        q = self.joints.reference
        return State(q, jnp.zeros(self.nv, q.dtype), self.start(q.dtype))

    def start(self, dtype: Any) -> jax.Array | None:
        """Return the initial states x (nx,) of the force elements, or None if none has a state."""
        if not self.nx:
            return None
        return jnp.concatenate([e.start().astype(dtype) for e in self.forces if e.size])

    def with_forces(self, *elements: Any) -> Model:
        """Return a copy with more force elements (`rbjax.forces`). The actuators still act."""
        return self._with("forces", "Element", "loads", with_warning(self, elements))

    def with_constraints(self, *constraints: Any) -> Model:
        """Return a copy with more constraints (`rbjax.constraints`)."""
        return self._with("constraints", "Constraint", "rows", constraints)

    def _with(self, room: str, kind: str, method: str, given: tuple) -> Model:
        for one in given:
            if isinstance(one, type) or not callable(getattr(one, method, None)):
                expected = f"{kind}s of rbjax.{room} or of a subclass of rbjax.{room}.{kind}"
                raise InputError(f"with_{room}: got {_described(one)}, expected {expected}")
        return self.replace(**{room: (*getattr(self, room), *given)})

    def with_joint(self, name: str, kind: str, **given: Any) -> Model:
        """Return a copy with a joint replaced by one of another kind (`rbjax.joints.kinds()`).

        The new joint keeps the anchor and the axis, in the frame of its body. If it has as many
        coordinates as the old joint, it keeps armature, damping and reference. If both joints have
        one coordinate, it keeps the spring and the ranges too. Entry k of the gear of an actuator
        acts on coordinate k of the new joint.

        Args:
            name: the joint.
            kind: the name of the new kind.
            given: axis (3,), reference (nq of the joint,), and parameters of the kind by name.

        Raises:
            UnknownName: no such joint, kind or parameter.
            InputError: a value of the wrong shape, not real or not finite; a zero axis or
                quaternion; a force element with a parameter for each coordinate of the old joint.

        Example:
            >>> import rbjax as rb
            >>> model = rb.load("cart_pole").with_joint("slider", "screw", pitch=0.01)
            >>> model.topology.joint_kinds
            ('screw', 'hinge')
        """
        return with_joint(self, name, kind, **given)

    def with_link(self, name: str, joint: Any, parent: str = "world", **given: Any) -> Model:
        """Return a copy with one more joint and its body, as `rbjax.model.with_link` does."""
        return with_link(self, name, joint, parent, **given)

    def with_beam(self, name: str, beam: Any, parent: str = "world", **given: Any) -> Model:
        """Return a copy with a flexible beam from a body or the world (`rbjax.flexible.Beam.add`).

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(0.5, [1.0, 2.0, 2.0, 0, 0, 0], {"k_y": 2}, mass=0.3)
            >>> rb.load("<mujoco/>").with_beam("rod", rod).nv
            3
        """
        if isinstance(beam, type) or not callable(getattr(beam, "add", None)):
            raise InputError(
                f"with_beam: beam is {_described(beam)}, expected a beam of rbjax.flexible.beam"
            )
        return beam.add(self, name, parent, **given)

    def keyframe(self, name: str) -> State:
        """Return the state of a keyframe of the file."""
        i = index_of("keyframe", name, self.keyframe_names)
        q, own, x = self.keyframes.q[i], self.keyframes.x, self.start(self.keyframes.q.dtype)
        if x is not None and own is not None and own.shape[1] <= x.size:
            x = x.at[: own.shape[1]].set(own[i])
        return State(q, self.keyframes.v[i], x)

    def random_state(self, key: jax.Array) -> State:
        """Draw a random state.

        Coordinates are uniform within 1 of the default state and within the ranges of the joints.
        Attitudes are uniform. The angle of a ball joint with a range is scaled into the range.
        Velocities are normal with standard deviation 1.
        """
        return State(*random_coordinates(self, key), self.start(self.joints.reference.dtype))


def _described(x: Any) -> str:
    return f"the class {x.__name__}" if isinstance(x, type) else type(x).__name__


def _checked_part(name: str, value: Any) -> Any:
    """Return the value of a field of a model, a list as a tuple. Raise InputError if its class is
    wrong, or if two sensors have the same name."""
    where = f"Model.replace({name}=...)"
    kind = RECORDS.get(name)
    missing = value is None and name in OPTIONAL
    if name == "contact" and value is not None and not callable(getattr(value, "solve", None)):
        choice("contact law", value, CONTACT_NAMES)
    if kind is not None and not missing and not isinstance(value, kind):
        more = " or None" if name in OPTIONAL else ""
        raise InputError(
            f"{where}: got {_described(value)}, expected {kind.__name__}{more}, such as "
            f"model.{name}.replace(...)"
        )
    if name not in TUPLES:
        return value
    expected, method = TUPLES[name]
    if not isinstance(value, tuple | list):
        raise InputError(f"{where}: got {_described(value)}, expected a tuple of {expected}")
    for one in value:
        named = name != "sensors" or isinstance(getattr(one, "name", None), str)
        if isinstance(one, type) or not callable(getattr(one, method, None)) or not named:
            raise InputError(f"{where}: got {_described(one)} in it, expected {expected}")
    if name == "sensors":
        names = [one.name for one in value]
        twice = [x for k, x in enumerate(names) if x in names[:k]]
        if twice:
            raise InputError(f"{where}: {twice[0]!r} is the name of two sensors, expected one")
    return tuple(value)
