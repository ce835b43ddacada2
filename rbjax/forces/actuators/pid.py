"""A PID controller: position and velocity setpoints, feedforward, integral action.

    f = kp (u_pos - l) + kv (u_vel - l') + ki x_I + u_ff,      x_I' = u_pos - l
(MuJoCo, *XML reference*, actuator/pid.) The first input may be rate-limited: a state then follows
it. The integral may be limited (anti-windup).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.actuators.activation import clip
from rbjax.forces.actuators.actuator import ForceLaw, Signals
from rbjax.lanes import Lane, add, mul, neg, sub
from rbjax.model.leaves import numbers, scalar, table
from rbjax.model.record import Record

#: names of the possible inputs of a controller, in the order of the controls
INPUTS = ("pos", "vel", "ff")


class PIDController(Record):
    """A PID controller.

    gains: (3,) kp, ki, kv.
    windup, slew: () limits of the integral and of the rate of the first input; infinite for none.
    inputs: names of its inputs, from INPUTS; static.
    slews: whether the rate-limited input is a state (the first); static.
    integrates: whether the integral is a state; static.
    circular: whether positions are angles, shifted by full turns to be nearest to l; static.
    clipped: whether a step clips the integral to the windup limit; otherwise the integral only
        stops growing; static.
    """

    gains: jax.Array
    windup: jax.Array
    slew: jax.Array
    inputs: tuple[str, ...] = eqx.field(static=True)
    slews: bool = eqx.field(static=True, default=False)
    integrates: bool = eqx.field(static=True, default=False)
    circular: bool = eqx.field(static=True, default=False)
    clipped: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        """The number of states of the controller."""
        return self.slews + self.integrates

    def output(self, seen: Signals, h: Any, x: Sequence[Lane]) -> Lane:
        """Compute the output in a step h, with the integral among the states x."""
        kp, ki, kv = numbers(self.gains, seen.dtype)
        u = self.setpoints(seen, h)
        out = mul(kp, sub(u.get("pos", 0.0), seen.length))
        out = add(out, mul(kv, sub(u.get("vel", 0.0), seen.speed)))
        if self.integrates:
            out = add(out, mul(ki, x[int(self.slews)]))
        return add(out, u.get("ff", 0.0))

    def setpoints(self, seen: Signals, h: Any) -> dict[str, Lane]:
        """Return the inputs by name, with the first one rate-limited over a step h."""
        u = dict(zip(self.inputs, seen.u, strict=False))
        if self.slews:
            u[self.inputs[0]] = self._slewed(seen, h)
        if self.circular and "pos" in u:
            u["pos"] = seen.nearest(u["pos"], seen.length)
        return u

    def _slewed(self, seen: Signals, h: Any) -> Lane:
        """Compute the rate-limited first input after a step h."""
        u, x, reach = seen.u[0], seen.x[0], h * scalar(self.slew, seen.dtype)
        target = seen.nearest(u, x) if self.circular and self.inputs[0] == "pos" else u
        return jnp.clip(target, x - reach, x + reach)

    def rate(self, seen: Signals, h: Any) -> list[Lane]:
        """Compute the rates of the states over a step h."""
        out: list[Lane] = []
        if self.slews:
            out.append((self._slewed(seen, h) - seen.x[0]) / h)
        if self.integrates:
            u, x = self.setpoints(seen, h), seen.x[int(self.slews)]
            error = sub(u.get("pos", 0.0), seen.length)
            windup = scalar(self.windup, seen.dtype)
            error = jnp.where(x >= windup, jnp.minimum(error, 0.0), error)
            out.append(jnp.where(x <= -windup, jnp.maximum(error, 0.0), error))
        return out

    def advanced(self, seen: Signals, h: Any) -> list[Lane]:
        """Compute the states after a step h."""
        x = [x + h * rate for x, rate in zip(seen.x, self.rate(seen, h), strict=False)]
        return self.within(x, seen.dtype)

    def within(self, x: Sequence[Lane], dtype: Any) -> list[Lane]:
        """Clip the integral to the windup limit if it is `clipped`."""
        x = list(x)
        if self.integrates and self.clipped:
            windup = scalar(self.windup, dtype)
            x[self.slews] = jnp.clip(x[self.slews], neg(windup), windup)
        return x


class PID(ForceLaw):
    """A force law whose force is the output of a PID controller.

    offset: () constant force that is added.
    limits: (2,) range of the states.
    early: whether the force uses the integral after the step; static.
    """

    controller: PIDController
    offset: jax.Array
    limits: jax.Array
    early: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return self.controller.size

    def force(self, seen: Signals) -> Lane:
        x = self.advanced(seen, seen.h) if self.early else seen.x
        return add(self.controller.output(seen, seen.h, x), scalar(self.offset, seen.dtype))

    def rate(self, seen: Signals) -> Sequence[Lane]:
        return self.controller.rate(seen, seen.h)

    def advanced(self, seen: Signals, dt: Any) -> Sequence[Lane]:
        return self._ranged(self.controller.advanced(seen, dt), seen.dtype)

    def within(self, x: Sequence[Lane], dtype: Any, turn: Callable) -> Sequence[Lane]:
        return self._ranged(self.controller.within(x, dtype), dtype)

    def _ranged(self, x: Sequence[Lane], dtype: Any) -> list[Lane]:
        limits = table(self.limits, dtype)[None]
        return [clip(a, limits, 0) for a in x]
