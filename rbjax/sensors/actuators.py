"""Sensors of actuators and tendons: length, velocity and force of a transmission.

    actuatorpos, tendonpos   l(q)        actuatorvel, tendonvel   l'
    actuatorfrc              f(u, x, l, l')
    tendonlimitpos           d = l - lower or upper - l, if d < margin, else 0
(MuJoCo, *Computation*, transmission.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.acting import element_contexts, tendon_scales
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.transmissions import TendonLength
from rbjax.forces.context import Context
from rbjax.forces.reach import Reach
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, neg
from rbjax.model import Model
from rbjax.model.leaves import numbers, scalar
from rbjax.sensors.fixed import FixedSensor, reading
from rbjax.sensors.protocol import register


def actuator_context(context: Context, actuator: str | int) -> tuple[Actuator, Context] | None:
    """Return an actuator and a context with its state; None if its control drives nothing."""
    control = context.model.actuator(actuator)
    pairs = context.once(actuator_context, lambda: element_contexts(context.model, context))
    for element, seen in pairs:
        if control in getattr(element, "controls", ()) and isinstance(element, Actuator):
            return element, seen
    return None


class ActuatorSensor(FixedSensor):
    """Base class of a sensor of an actuator. actuator: name or index of its control; static."""

    actuator: str | int = eqx.field(static=True)

    def check(self, model: Model) -> None:
        model.actuator(self.actuator)

    def reach(self, context: Context) -> Reach:
        """Return the length and the moment arms of the actuator."""
        found = actuator_context(context, self.actuator)
        if found is None:
            return Reach(jnp.zeros((), context.q.dtype), {})
        element, seen = found
        return seen.once(element.transmission, lambda: element.transmission.reach(seen))


@register("actuatorpos", placed=True)
class ActuatorPosition(ActuatorSensor):
    """Measure the length of an actuator, gear times the coordinate of its joint or tendon."""

    of = "rad or m"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [self.reach(context).length])


@register("actuatorvel", placed=True)
class ActuatorVelocity(ActuatorSensor):
    """Measure the rate of the length of an actuator."""

    of = "rad/s or m/s"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [self.reach(context).speed(context)])


@register("actuatorfrc", placed=True)
class ActuatorForce(ActuatorSensor):
    """Measure the scalar force of an actuator, before its gear; zero without controls."""

    of = "N m or N"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [actuator_force(context, self.actuator)])


def actuator_force(context: Context, actuator: str | int) -> Lane:
    """Return the scalar force of an actuator."""
    found = actuator_context(context, actuator)
    if found is None or context.ctrl is None:
        return jnp.zeros((), context.q.dtype)
    element, seen = found
    return element.output(replace(seen, scales=_scales(context)))


def _scales(context: Context) -> dict[int, Lane]:
    """Return `tendon_scales` by tendon, computed once per context."""
    pairs = context.once(actuator_context, lambda: element_contexts(context.model, context))
    return context.once(tendon_scales, lambda: tendon_scales(context.model, pairs))


class TendonSensor(FixedSensor):
    """Base class of a sensor of a tendon.

    tendon: name or index; static.
    """

    tendon: str | int = eqx.field(static=True)

    def check(self, model: Model) -> None:
        model.tendon(self.tendon)

    def reach(self, context: Context) -> Reach:
        """Return the length and the moment arms of the tendon."""
        return tendon_reach(context, self.tendon)


@register("tendonpos", placed=True)
class TendonPosition(TendonSensor):
    """Measure the length of a tendon."""

    of = "m"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [self.reach(context).length])


@register("tendonvel", placed=True)
class TendonVelocity(TendonSensor):
    """Measure the rate of the length of a tendon."""

    of = "m/s"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [self.reach(context).speed(context)])


@register("tendonactuatorfrc", placed=True)
class TendonActuatorForce(TendonSensor):
    """Measure the sum of the forces of the actuators at a tendon."""

    of = "N"

    def __call__(self, context: Context) -> jax.Array:
        own, zero = context.model.tendon(self.tendon), jnp.zeros((), context.q.dtype)
        found = [force for tendon, _, force in forces_at_tendons(context) if tendon == own]
        return reading(context, [sum(found, zero)])


def forces_at_tendons(context: Context) -> list[tuple[int, Lane, Lane]]:
    """List the actuators at tendons: index of the tendon, gear, scalar force."""
    if context.ctrl is None:
        return []
    pairs = context.once(actuator_context, lambda: element_contexts(context.model, context))
    out = []
    for element, seen in pairs:
        if isinstance(element, Actuator) and isinstance(element.transmission, TendonLength):
            gear = numbers(element.transmission.gear, context.q.dtype)[0]
            force = element.output(replace(seen, scales=_scales(context)))
            out.append((context.model.tendon(element.transmission.tendon), gear, force))
    return out


class TendonLimitSensor(TendonSensor):
    """Base class of the sensors of a tendon's limit. They read zero unless the length is within
    `limit_margin` of the limit."""

    def margin(self, context: Context) -> Lane:
        """Return the distance from a limit, m, below which the sensor reads it."""
        own: Any = context.model.tendons
        return scalar(own.limit_margin[context.model.tendon(self.tendon)], context.q.dtype)

    def nearest(self, context: Context, value: Callable[[Lane, Lane], Lane]) -> jax.Array:
        """Return value(distance, rate) at a limit within the margin, or zero.

        distance: distance to the limit, m. rate: its rate, m/s. The lower limit precedes the upper
            one.
        """
        own: Any = context.model.tendons
        limits = own.range[context.model.tendon(self.tendon)]
        reach, (low, high) = self.reach(context), numbers(limits, context.q.dtype)
        length = jnp.asarray(reach.length, context.q.dtype)
        speed = reach.speed(context)
        out = jnp.zeros((), context.q.dtype)
        for distance, rate in ((high - length, neg(speed)), (length - low, speed)):
            out = jnp.where(distance < self.margin(context), value(distance, rate), out)
        return reading(context, [out])


@register("tendonlimitpos", placed=True)
class TendonLimitPosition(TendonLimitSensor):
    """Measure the distance of a tendon's length to its limit, less the margin; zero if positive."""

    of = "m"

    def __call__(self, context: Context) -> jax.Array:
        return self.nearest(context, lambda distance, _: distance - self.margin(context))


@register("tendonlimitvel", placed=True)
class TendonLimitVelocity(TendonLimitSensor):
    """Measure the rate of a tendon's distance to its limit; zero outside of the margin."""

    of = "m/s"

    def __call__(self, context: Context) -> jax.Array:
        return self.nearest(context, lambda _, rate: rate)
