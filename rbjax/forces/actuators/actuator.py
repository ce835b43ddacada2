"""Actuators: a transmission, and a force law from controls to a force.

    tau = r(q) f(u, x, l, l'),      x' = rate(u, x, l, l')
(MuJoCo, *Computation*, actuation model.) `model.actuators` stores as columns the actuators at a
joint or a site that have no state and are affine in their control,

    f = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l').
A model of many motors then has five arrays, which can be identified, instead of five per motor.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.forces.actuators.activation import Activation, Muscle, clip
from rbjax.forces.actuators.transmissions import (
    JointAxis,
    SiteWrench,
    TendonLength,
    Transmission,
)
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads
from rbjax.forces.reach import Reach
from rbjax.forces.slopes import Slope, derivatives
from rbjax.lanes import Lane, add, inner, is_zero, mul, neg
from rbjax.model import Model
from rbjax.model.components import Actuators
from rbjax.model.leaves import numbers, table
from rbjax.model.record import Record


class Signals:
    """The inputs of a force law.

    u: controls, clipped to their ranges.
    x: state of the law.
    length, speed: length of the transmission and its rate.
    h: time step in s; the model's timestep if no step is fixed.
    """

    def __init__(self, context: Context, u: Sequence[Lane], transmission: Transmission):
        self.u, self.x, self.dtype = u, context.x, context.q.dtype
        self.h = context.h
        self._now, self._transmission = context, transmission

    @property
    def reach(self) -> Reach:
        """The length and moment arms of the transmission."""
        return self._now.once(self._transmission, lambda: self._transmission.reach(self._now))

    @property
    def length(self) -> Lane:
        """The length l of the transmission."""
        return self.reach.length

    @property
    def speed(self) -> Lane:
        """The rate l' of the length."""
        return self._now.once(self.reach, lambda: self.reach.speed(self._now))

    @property
    def turn(self) -> Lane:
        """The change of the length l when the joint rotates by a full turn."""
        return self._transmission.turn(self.dtype)

    def derivatives(self, f: Callable[[Signals], Lane]) -> tuple[Lane, Lane]:
        """Compute the derivatives of a force f(signals) by the length and by its rate."""

        def force(length: Lane, speed: Lane) -> Lane:
            return jnp.asarray(f(_Moved(self, length, speed)), self.dtype)

        return derivatives(force, self.length, self.speed, self.dtype)

    def nearest(self, angle: Lane, to: Lane) -> Lane:
        """Shift an angle by full turns to be nearest to another angle."""
        return angle - self.turn * jnp.round((angle - to) / self.turn)


class _Moved(Signals):
    """Signals with replaced length and speed, to differentiate a force by them."""

    length: Lane = 0.0
    speed: Lane = 0.0

    def __init__(self, of: Signals, length: Lane, speed: Lane):
        self.__dict__.update(of.__dict__)
        self.length, self.speed = length, speed


class ForceLaw(Record):
    """Base class of a map from an actuator's controls, state, length and speed to its force."""

    @property
    def size(self) -> int:
        """The size of the state of the law."""
        return 0

    @abc.abstractmethod
    def force(self, seen: Signals) -> Lane:
        """Compute the force, which the actuator then clips to its force range."""

    def friction(self, seen: Signals) -> Lane:
        """Compute the additional force that is not clipped."""
        return 0.0

    def rate(self, seen: Signals) -> Sequence[Lane]:
        """Compute the rate x' of the state."""
        return []

    def advanced(self, seen: Signals, dt: Any) -> Sequence[Lane]:
        """Compute the state x after a step dt."""
        return []

    def within(self, x: Sequence[Lane], dtype: Any, turn: Callable) -> Sequence[Lane]:
        """Clip the state x to its range. turn(dtype): change of the length over a full turn."""
        return x

    def slopes(self, seen: Signals) -> tuple[Lane, Lane]:
        """Compute the derivatives (df/dl, df/dl') of the force by length and rate, for an implicit
        step."""
        return seen.derivatives(self.force)

    def friction_slopes(self, seen: Signals) -> tuple[Lane, Lane]:
        """Compute the derivatives of the friction by length l and speed l'."""
        if type(self).friction is ForceLaw.friction:
            return 0.0, 0.0
        return seen.derivatives(self.friction)


class Actuator(Element):
    """A force element that consists of a transmission and a force law.

    ctrlrange: (n, 2) range of each control, infinite for none.
    forcerange: (2,) range of the force, infinite for none.
    controls: indices of its controls among the model's; static.
    """

    transmission: Transmission
    law: ForceLaw
    ctrlrange: jax.Array
    forcerange: jax.Array
    controls: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        return self.law.size

    @property
    def actuates(self) -> bool:
        return True

    def output(self, context: Context) -> Lane:
        """Compute the scalar force, which the moment arms of the transmission multiply."""
        return self._output(self._signals(context), context.scales.get(self.tendon, 1.0))

    def _output(self, seen: Signals, scale: Lane) -> Lane:
        limits = table(self.forcerange, seen.dtype)[None]
        force = jnp.asarray(self.law.force(seen), seen.dtype)
        force = mul(force, scale)
        return add(clip(force, limits, 0), self.law.friction(seen))

    def loads(self, context: Context) -> Loads:
        seen = self._signals(context)
        force = self._output(seen, context.scales.get(self.tendon, 1.0))
        return Loads({n: mul(arm, force) for n, arm in seen.reach.arms.items()})

    @property
    def tendon(self) -> int:
        """The tendon that the actuator pulls, or -1."""
        return self.transmission.tendon if isinstance(self.transmission, TendonLength) else -1

    @property
    def joint(self) -> int:
        """The joint that the actuator drives, or -1."""
        return self.transmission.joint if isinstance(self.transmission, JointAxis) else -1

    def force(self, context: Context) -> Lane:
        """Compute the force of the law, before the limits of its range."""
        return jnp.asarray(self.law.force(self._signals(context)), context.q.dtype)

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the stiffness and damping of the force. They are zero if the force is at a limit
        of its range."""
        seen = self._signals(context)
        slopes: tuple[Lane, ...] = self.law.slopes(seen)
        if not all(map(is_zero, slopes)):
            scale = context.scales.get(self.tendon, 1.0)
            force, limits = self.law.force(seen), table(self.forcerange, seen.dtype)[None]
            force = jnp.asarray(force, seen.dtype)
            inside = (clip(force, limits, 0) == force) & (jnp.asarray(scale, seen.dtype) == 1)
            slopes = tuple(x if is_zero(x) else jnp.where(inside, x, 0.0) for x in slopes)
        k, d = map(add, slopes, self.law.friction_slopes(seen))
        if is_zero(k) and is_zero(d):
            return []
        return [Slope(seen.reach.arms, neg(k), neg(d))]

    def rate(self, context: Context) -> Sequence[Lane]:
        return [0.0] * self.size if context.ctrl is None else self.law.rate(self._signals(context))

    def advance(self, context: Context, dt: Any) -> Sequence[Lane]:
        return context.x if context.ctrl is None else self.law.advanced(self._signals(context), dt)

    def within(self, x: jax.Array) -> Sequence[Lane]:
        return self.law.within(list(x), x.dtype, self.transmission.turn)

    def _signals(self, context: Context) -> Signals:
        limits = table(self.ctrlrange, context.q.dtype)
        u = [clip(context.ctrl[k], limits, i) for i, k in enumerate(self.controls)]
        return Signals(context, u, self.transmission)


_ZERO: Any = np.zeros(1)


class Affine(Record):
    """An affine function c0 + c1 l + c2 l'; with one coefficient (1,) a constant."""

    coefficients: jax.Array

    def __call__(self, seen: Signals) -> Lane:
        found = numbers(self.coefficients, seen.dtype)
        return found[0] if len(found) == 1 else inner(found, (1.0, seen.length, seen.speed))

    def slopes(self, dtype: Any) -> Sequence[Lane]:
        """Return the derivatives c1 and c2 of the force by length and velocity."""
        return numbers(self.coefficients, dtype)[1:] or (0.0, 0.0)


class Active(Record):
    """The active force of a muscle at full activation."""

    muscle: Muscle

    def __call__(self, seen: Signals) -> Lane:
        return self.muscle.active(seen.length, seen.speed, seen.dtype)


class Passive(Record):
    """The passive force of a muscle."""

    muscle: Muscle

    def __call__(self, seen: Signals) -> Lane:
        return self.muscle.passive(seen.length, seen.dtype)


class GainBias(ForceLaw):
    """The force law gain a + bias, with the activation a, or the control if it has no activation.

    early: whether the force uses the activation after the step; static.
    circular: whether a is an angle, shifted by full turns to be nearest to l; static.
    """

    gain: Affine | Active
    bias: Affine | Passive | None
    activation: Activation | None
    early: bool = eqx.field(static=True, default=False)
    circular: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return 0 if self.activation is None else 1

    def force(self, seen: Signals) -> Lane:
        bias = 0.0 if self.bias is None else self.bias(seen)
        return add(mul(self.gain(seen), self._activation(seen)), bias)

    def slopes(self, seen: Signals) -> tuple[Lane, Lane]:
        gain, bias = self.gain, Affine(_ZERO) if self.bias is None else self.bias
        if not isinstance(gain, Affine) or not isinstance(bias, Affine):
            return super().slopes(seen)
        by_gain, by_bias = gain.slopes(seen.dtype), bias.slopes(seen.dtype)
        if all(map(is_zero, by_gain)):
            return by_bias[0], by_bias[1]
        a = self._activation(seen)
        by_length, by_speed = (add(mul(g, a), b) for g, b in zip(by_gain, by_bias, strict=True))
        return by_length, by_speed

    def rate(self, seen: Signals) -> Sequence[Lane]:
        if self.activation is None:
            return []
        return [self.activation.rate(self._control(seen), seen.x[0])]

    def advanced(self, seen: Signals, dt: Any) -> Sequence[Lane]:
        if self.activation is None:
            return []
        a = self.activation.advanced(self._control(seen), seen.x[0], dt)
        return [seen.nearest(a, seen.length) if self.circular else a]

    def within(self, x: Sequence[Lane], dtype: Any, turn: Callable) -> Sequence[Lane]:
        if self.activation is None:
            return x
        period = turn(dtype) if self.circular else None
        return [self.activation.within(a, period) for a in x]

    def _activation(self, seen: Signals) -> Lane:
        """Return the activation a, or the control if the law has no activation."""
        if self.activation is None:
            a = seen.u[0]
        elif self.early:
            a = self.activation.advanced(self._control(seen), seen.x[0], seen.h)
        else:
            a = seen.x[0]
        return seen.nearest(a, seen.length) if self.circular else a

    def _control(self, seen: Signals) -> Lane:
        """Return the control u.

        If the law is circular and its activation follows the control, u is shifted by full turns to
        be nearest to the activation.
        """
        followed = self.activation is not None and self.activation.follows
        return seen.nearest(seen.u[0], seen.x[0]) if self.circular and followed else seen.u[0]


def is_affine(element: Any) -> bool:
    """Check whether an element can be a row of `model.actuators`."""
    if type(element) is not Actuator or type(element.law) is not GainBias:
        return False
    law, transmission = element.law, element.transmission
    axis = isinstance(transmission, JointAxis) and not transmission.in_parent
    affine = isinstance(law.gain, Affine) and (law.bias is None or isinstance(law.bias, Affine))
    stateless = law.activation is None and not law.circular and len(element.controls) == 1
    return affine and stateless and (axis or isinstance(transmission, SiteWrench))


def from_columns(model: Model) -> tuple[Actuator, ...]:
    """Return the rows of `model.actuators` that drive a joint or a site as elements."""
    own = model.actuators
    names = ("gear", "gain", "bias", "ctrlrange", "forcerange")
    columns = (getattr(own, n) for n in names)
    parts: Any = (x if isinstance(x, np.ndarray) else table(x, x.dtype) for x in columns)
    gear, gain, bias, ctrl, force = parts

    def element(i: int) -> Actuator:
        joint, site = own.joints[i], own.sites[i]
        transmission = JointAxis(gear[i], joint) if site < 0 else SiteWrench(gear[i], site)
        law = GainBias(Affine(gain[i]), Affine(bias[i]), None)
        return Actuator(transmission, law, ctrl[i : i + 1], force[i], (i,))

    driving = (i for i in range(model.nu) if own.joints[i] >= 0 or own.sites[i] >= 0)
    return tuple(map(element, driving))


def to_columns(elements: Iterable[Any], nu: int) -> Actuators:
    """Convert affine actuators to columns with nu rows. Rows of other controls drive nothing."""
    gear, gain, bias = np.zeros((nu, 6)), np.zeros((nu, 3)), np.zeros((nu, 3))
    ctrlrange, forcerange = np.tile([-np.inf, np.inf], (2, nu, 1))
    joints, sites = [-1] * nu, [-1] * nu
    for one in elements:
        (i,), law, transmission = one.controls, one.law, one.transmission
        gear[i], ctrlrange[i], forcerange[i] = transmission.gear, one.ctrlrange[0], one.forcerange
        gain[i, : law.gain.coefficients.size] = law.gain.coefficients
        if law.bias is not None:
            bias[i, : law.bias.coefficients.size] = law.bias.coefficients
        if isinstance(transmission, SiteWrench):
            sites[i] = transmission.site
        else:
            joints[i] = transmission.joint
    make: Any = Actuators  # with NumPy arrays
    columns = gear, gain, bias, ctrlrange, forcerange
    return make(*columns, joints=tuple(joints), sites=tuple(sites))
