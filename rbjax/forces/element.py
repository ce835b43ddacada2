"""The protocol of force elements, and the loads that an element returns.

An element is a record of parameters with a method `loads`, from a `Context` to generalized forces,
wrenches on bodies, or both. An element with a state of its own has a `size`, a `start` and a
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
from rbjax.lanes import Lane, add, mul
from rbjax.model import Model
from rbjax.model.record import Record, check_above_zero, check_fields
from rbjax.spatial import Force

if TYPE_CHECKING:
    from rbjax.forces.context import Context

#: the shapes of an element's parameters by the names of its fields; None for any length
Shapes = Mapping[str, tuple[int | None, ...]]


@dataclass(frozen=True)
class Loads:
    """Forces on a robot, which can be added. `Frame.push` and `Joint.push` make them.

    tau: generalized forces by velocity coordinate.
    wrenches: forces by link, in the link's axes at its origin, or columns over all links.
    internal: whether the wrenches are actions and reactions between links; a joint that carries
        both has no force of them.
    """

    tau: Mapping[int, Lane] = field(default_factory=dict)
    wrenches: LinkForces = field(default_factory=dict)
    internal: bool = False

    def __add__(self, other: Loads) -> Loads:
        internal = all(x.internal or not x.wrenches for x in (self, other))
        wrenches = add_forces(self.wrenches, other.wrenches)
        return Loads(_summed(self.tau, other.tau), wrenches, internal)

    def __radd__(self, other: Any) -> Loads:
        return self if isinstance(other, int) and other == 0 else NotImplemented  # of sum()

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
    """A force on a robot. A subclass has the element's parameters as fields.

    Only `loads` must be written. The other methods are for elements with a state of their own, and
    for elements that store energy.

    Example:
        >>> import rbjax as rb, jax, jax.numpy as jnp
        >>> class Wind(rb.forces.Element):
        ...     air: jax.Array  # (3,) m/s in the world
        ...     drag: jax.Array  # N s/m
        ...     def loads(self, now):
        ...         trunk = now.body("trunk")
        ...         return trunk.push((trunk.velocity - self.air) * -self.drag)
        >>> model = rb.load("quadruped").with_forces(Wind(jnp.array([8.0, 0, 0]), jnp.array(5.0)))
        >>> rb.applied_forces(model, model.default_state())[:3].tolist()
        [40.0, 0.0, 0.0]
    """

    #: fields whose values must be above zero
    positive: ClassVar[tuple[str, ...]] = ()
    #: fields whose values may be infinite; None for all
    unlimited: ClassVar[tuple[str, ...] | None] = None

    def __check_init__(self) -> None:
        check_fields(self)
        for name in self.positive:
            check_above_zero(f"{type(self).__name__}({name}=...)", getattr(self, name))

    def may_be_infinite(self, name: str) -> bool:
        return self.unlimited is None or name in self.unlimited

    def shapes(self, model: Model) -> Shapes:
        """The shapes of its parameters on a model, by field, checked when the element acts; None
        for any length."""
        return {}

    @property
    def size(self) -> int:
        """The size of its own state."""
        return 0

    @property
    def actuates(self) -> bool:
        """Whether its generalized forces are an actuator's: absent without controls, and clipped to
        the force ranges of the joints."""
        return False

    @property
    def after_actuators(self) -> bool:
        """Whether `loads` reads `now.driven`, the generalized forces of all actuators."""
        return False

    def loads(self, now: Context) -> Loads:
        """The forces on the robot at an instant."""
        raise NotImplementedError(f"{type(self).__name__} has no method loads(self, now) -> Loads")

    def start(self) -> jax.Array:
        """The initial state (size,), unless a `State` gives one."""
        return jnp.zeros(self.size)

    def rate(self, now: Context) -> Sequence[Lane]:
        """The rate (size,) of its own state."""
        raise NotImplementedError(
            f"{type(self).__name__} has a state of size {self.size}, and no method "
            "rate(self, now) -> (size,)"
        )

    def advance(self, now: Context, dt: Any) -> Sequence[Lane]:
        """Its own state after a step dt of `semi_implicit_euler`: x + dt x', unless the element
        overrides it, for limits or an exact solution."""
        return [add(x, mul(dt, rate)) for x, rate in zip(now.x, self.rate(now), strict=True)]

    def implicit_stiffness(self, now: Context, h: Any) -> Mapping[int, Lane]:
        """h D / 2 + h^2 K / 4 by velocity coordinate, where -D and -K are the slopes of its
        generalized forces: the diagonal terms that forces at the middle of a step h add to the mass
        matrix. They affect only the convergence of an implicit step."""
        return {}

    def within(self, x: jax.Array) -> Sequence[Lane]:
        """Clip the element's state x to its range. `rollout` does so after each step, with any
        integrator."""
        return list(x)

    def energy(self, now: Context) -> Lane:
        """The energy that it stores, in joules."""
        return 0.0


def check_shapes(element: Element, model: Model) -> None:
    """Raise if the shape of a parameter is not that of the element on the model."""
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
    """Parameters (n,) of the velocity coordinates of joints, each from one number for all or (n,);
    None stays None."""
    check_model(where, model)
    n, dtype = coordinates(model, joints), model.gravity.dtype

    def column(name: str, x: Any) -> jax.Array:
        return jnp.broadcast_to(check_array(where, name, x, (), (n,)).astype(dtype), (n,))

    return {name: None if x is None else column(name, x) for name, x in given.items()}


def coordinates(model: Model, joints: Iterable[str | int]) -> int:
    """The number of velocity coordinates of joints."""
    return sum(model.topology.joints[model.joint(j)].nv for j in joints)
