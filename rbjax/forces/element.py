"""The protocol of force elements, and the loads that an element returns.

An element is a record of parameters with a method `loads`, from a `Context` to generalized forces,
wrenches on bodies, or both. An element with a state of its own also defines `size`, `start` and
`rate`:

    tau, w = loads(t, q, v, x, ctrl),      x' = rate(t, q, v, x, ctrl)

The parameters are leaves: they can be differentiated, vmapped over and changed without
recompilation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.rnea import LinkForces, add_forces
from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, add, mul
from rbjax.model import Model
from rbjax.model.record import Record, check_above_zero, check_fields
from rbjax.spatial import Force

if TYPE_CHECKING:
    from rbjax.forces.context import Context

#: field name -> shape of the parameter; None in a shape for any length
Shapes = Mapping[str, tuple[int | None, ...]]


@dataclass(frozen=True)
class Loads:
    """Forces on a robot, which can be added. `FrameState.push` and `JointState.push` make them.

    tau: generalized forces by dof.
    wrenches: forces by link, in link axes at the link's origin, or columns over all links.
    internal: whether the wrenches are actions and reactions between links. They cancel in a joint
        that carries both links of a pair.
    """

    tau: Mapping[int, Lane] = field(default_factory=dict)
    wrenches: LinkForces = field(default_factory=dict)
    internal: bool = False

    def __add__(self, other: Loads) -> Loads:
        internal = all(x.internal or not x.wrenches for x in (self, other))
        wrenches = add_forces(self.wrenches, other.wrenches)
        return Loads(_summed(self.tau, other.tau), wrenches, internal)

    def __radd__(self, other: Any) -> Loads:
        return self if isinstance(other, int) and other == 0 else NotImplemented  # start of sum()

    def __neg__(self) -> Loads:
        return self * -1.0

    def __mul__(self, scale: Lane) -> Loads:
        tau = {i: mul(x, scale) for i, x in self.tau.items()}
        if isinstance(self.wrenches, Force):
            return Loads(tau, self.wrenches * scale, self.internal)
        wrenches = {i: x * scale for i, x in self.wrenches.items()}
        return Loads(tau, wrenches, self.internal)

    __rmul__ = __mul__


def _summed(a: Mapping[int, Lane], b: Mapping[int, Lane]) -> dict[int, Lane]:
    out = dict(a)
    for i, x in b.items():
        out[i] = add(out.get(i, 0.0), x)
    return out


class Element(Record):
    """Base class of a force on a robot. The fields of a subclass are the element's parameters.

    Only `loads` is required. The other methods are for elements with a state of their own, and for
    elements that store energy.

    Example:
        >>> import rbjax as rb, jax, jax.numpy as jnp
        >>> class Wind(rb.forces.Element):
        ...     air: jax.Array  # (3,) m/s in the world
        ...     drag: jax.Array  # N s/m
        ...     def loads(self, context):
        ...         trunk = context.body("trunk")
        ...         return trunk.push((trunk.velocity - self.air) * -self.drag)
        >>> model = rb.load("quadruped").with_forces(Wind(jnp.array([8.0, 0, 0]), jnp.array(5.0)))
        >>> rb.applied_forces(model, model.default_state())[:3].tolist()
        [40.0, 0.0, 0.0]
    """

    #: fields whose values must be positive
    positive: ClassVar[tuple[str, ...]] = ()
    #: fields whose values may be infinite; None: all fields
    unlimited: ClassVar[tuple[str, ...] | None] = None

    def __check_init__(self) -> None:
        check_fields(self)
        for name in self.positive:
            check_above_zero(f"{type(self).__name__}({name}=...)", getattr(self, name))

    def may_be_infinite(self, name: str) -> bool:
        return self.unlimited is None or name in self.unlimited

    def shapes(self, model: Model) -> Shapes:
        """Return the shape of each parameter for a model, by field name. The element is checked
        with it when it is evaluated. None in a shape allows any length."""
        return {}

    @property
    def size(self) -> int:
        """The size of the element's own state."""
        return 0

    @property
    def actuates(self) -> bool:
        """Whether the generalized forces are an actuator's: zero without controls, and clipped to
        the force ranges of the joints."""
        return False

    @property
    def after_actuators(self) -> bool:
        """Whether `loads` reads the context's `driven`, the forces of all actuators."""
        return False

    def loads(self, context: Context) -> Loads:
        """Compute the forces on the robot at an instant."""
        raise NotImplementedError(
            f"{type(self).__name__} has no method loads(self, context) -> Loads"
        )

    def start(self) -> jax.Array:
        """Return the initial state (size,), used unless a `State` contains x."""
        return jnp.zeros(self.size)

    def rate(self, context: Context) -> Sequence[Lane]:
        """Compute the rate (size,) of the element's own state."""
        raise NotImplementedError(
            f"{type(self).__name__} has a state of size {self.size}, and no method "
            "rate(self, context) -> (size,)"
        )

    def advance(self, context: Context, dt: Any) -> Sequence[Lane]:
        """Compute the element's own state after a step dt of `semi_implicit_euler`. The default is
        x + dt x'; override it for limits or an exact solution."""
        return [
            add(x, mul(dt, rate)) for x, rate in zip(context.x, self.rate(context), strict=True)
        ]

    def slopes(self, context: Context) -> Iterable[Slope]:
        """Compute the stiffness and damping of the element's forces, for steps that are implicit in
        them (`implicitfast`, `discrete`, `variational_midpoint`). Forces without slopes are
        explicit."""
        return []

    def dissipative_slopes(self, context: Context) -> Iterable[Slope]:
        """Compute `slopes` without the forces that do no work, for the integrator `discrete`."""
        return self.slopes(context)

    def within(self, x: jax.Array) -> Sequence[Lane]:
        """Clip the element's state x to its range. `rollout` calls it after each step, with any
        integrator."""
        return list(x)

    def energy(self, context: Context) -> Lane:
        """Compute the potential energy of the element, J."""
        return 0.0


def check_shapes(element: Element, model: Model) -> None:
    """Raise InputError if a parameter has another shape than `Element.shapes` on the model."""
    for name, due in element.shapes(model).items():
        shape = np.shape(getattr(element, name))
        alike = [n in (m, None) for m, n in zip(shape, due, strict=False)]
        if len(shape) != len(due) or not all(alike):
            expected = str(tuple("any" if n is None else n for n in due)).replace("'", "")
            raise InputError(
                f"{type(element).__name__}: {name} has shape {shape}, expected {expected}; for a "
                "batch of elements or models use jax.vmap over them"
            )


def columns_of(
    where: str, model: Model, joints: Sequence[str | int], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Convert parameters of joints to arrays (n,) over their dofs. Each is one number for all dofs
    or (n,); None stays None."""
    check_model(where, model)
    n, dtype = coordinates(model, joints), model.gravity.dtype

    def column(name: str, x: Any) -> jax.Array:
        return jnp.broadcast_to(check_array(where, name, x, (), (n,)).astype(dtype), (n,))

    return {name: None if x is None else column(name, x) for name, x in given.items()}


def coordinates(model: Model, joints: Iterable[str | int]) -> int:
    """Count the dofs of joints."""
    return sum(model.topology.joints[model.joint(j)].nv for j in joints)
