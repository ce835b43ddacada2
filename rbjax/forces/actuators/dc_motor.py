"""A DC motor: voltage, current, heat, cogging and bearing friction.

    f = K i,      L i' = V - K l' - R i,      without inductance i = (V - K l') / R
    R = R0 (1 + alpha (T - T0)),      C T' = R i^2 - (T - Ta) / RT
    friction  -(s0 z + s1 z'),  z' = l' - s0 |l'| z / g(l'),  g = FC + (FS - FC) exp(-(l'/vS)^2)
(MuJoCo, *DC motor technical note*; LuGre: Canudas de Wit et al., 1995.) An integrated controller
applies V = (R/K) tau + K l', clipped to its limit. A terminal voltage is added to V.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.actuators.activation import at_least, lag_step
from rbjax.forces.actuators.actuator import ForceLaw, Signals
from rbjax.forces.actuators.pid import PIDController
from rbjax.lanes import Lane, add
from rbjax.model.leaves import numbers, scalar
from rbjax.model.record import Record


class Windings(Record):
    """The electrical parameters of a motor.

    resistance: () R0, resistance at T0.
    constant: () K, torque and back-EMF constant.
    drive: () limit of the controller's voltage.
    time_constant: () L / R, if the current is a state.
    current_rate: () limit of i', if the current is a state.
    inductive: whether the current is a state; static.
    """

    resistance: jax.Array
    constant: jax.Array
    drive: jax.Array
    time_constant: jax.Array
    current_rate: jax.Array
    inductive: bool = eqx.field(static=True)


class Heat(Record):
    """The thermal model of the windings, with the state T - Ta.

    numbers: (5,) thermal resistance RT K/W, heat capacity C J/K, ambient temperature Ta,
        temperature coefficient alpha 1/K, reference temperature T0.
    """

    numbers: jax.Array


class LuGre(Record):
    """The LuGre friction of the bearings. The state z is the deflection of the bristles.

    numbers: (5,) bristle stiffness s0 and damping s1, Coulomb force FC, static force FS, Stribeck
        velocity vS.
    """

    numbers: jax.Array

    def rate(self, z: Lane, speed: Lane, dtype: Any) -> Lane:
        """Compute the rate z' of the deflection."""
        return speed - self._decay(speed, dtype) * z

    def advanced(self, z: Lane, speed: Lane, h: Any, dtype: Any) -> Lane:
        """Compute z after a step at constant speed."""
        decay = self._decay(speed, dtype)
        some = decay > 1e-15
        lasting = jnp.where(some, decay, 1.0)
        pushed = jnp.where(some, -jnp.expm1(-decay * h) / lasting, h)
        return jnp.exp(-decay * h) * z + pushed * speed

    def force(self, z: Lane, speed: Lane, dtype: Any) -> Lane:
        """Compute the friction force s0 z + s1 z' of the bristles with deflection z."""
        stiffness, damping, *_ = numbers(self.numbers, dtype)
        return stiffness * z + damping * self.rate(z, speed, dtype)

    def _decay(self, speed: Lane, dtype: Any) -> Lane:
        """Compute the decay rate s0 |v| / g(v) of the bristle deflection, with g the Stribeck
        curve."""
        stiffness, _, coulomb, static, stribeck = numbers(self.numbers, dtype)
        ratio = speed / at_least(stribeck)
        g = coulomb + (static - coulomb) * jnp.exp(-ratio * ratio)
        return stiffness * jnp.abs(speed) / at_least(g)


class DCMotor(ForceLaw):
    """The force law of a DC motor. A part that the motor does not have is None.

    cogging: (3,) amplitude, number of poles, phase.
    voltage: whether the last control is a terminal voltage; static.

    The states are the controller's states, the temperature rise T - Ta, the bristle deflection z
    and the current i. Absent states are omitted.
    """

    windings: Windings
    cogging: jax.Array
    controller: PIDController | None
    heat: Heat | None
    bristles: LuGre | None
    voltage: bool = eqx.field(static=True)

    @property
    def size(self) -> int:
        own = (self.heat is not None) + (self.bristles is not None) + self.windings.inductive
        return own + (0 if self.controller is None else self.controller.size)

    def force(self, seen: Signals) -> Lane:
        K = scalar(self.windings.constant, seen.dtype)
        if not self.windings.inductive:
            return K * self._current(seen, seen.h)
        return K * self._current_after(seen, seen.h)  # MuJoCo uses the current after the step

    def friction(self, seen: Signals) -> Lane:
        amplitude, poles, phase = numbers(self.cogging, seen.dtype)
        out = amplitude * jnp.sin(poles * seen.length + phase)
        if self.bristles is None:
            return out
        z = self._parts(seen)["z"]
        return out - self.bristles.force(z, seen.speed, seen.dtype)

    def rate(self, seen: Signals) -> Sequence[Lane]:
        return self._rates(seen, seen.h)

    def advanced(self, seen: Signals, dt: Any) -> Sequence[Lane]:
        n = 0 if self.controller is None else self.controller.size
        out = [] if self.controller is None else self.controller.advanced(seen, dt)
        x = self._parts(seen)
        if self.heat is not None:
            out.append(x["T"] + dt * self._rates(seen, dt)[n])
        if self.bristles is not None:
            out.append(self.bristles.advanced(x["z"], seen.speed, dt, seen.dtype))
        if self.windings.inductive:
            out.append(self._current_after(seen, dt))
        return out

    def within(self, x: Sequence[Lane], dtype: Any, turn: Callable) -> Sequence[Lane]:
        if self.controller is None:
            return x
        n = self.controller.size
        return [*self.controller.within(x[:n], dtype), *x[n:]]

    def _parts(self, seen: Signals) -> dict[str, Lane]:
        """Return the temperature, friction and current states by name."""
        own = [("T", self.heat is not None), ("z", self.bristles is not None)]
        names = [name for name, there in [*own, ("i", self.windings.inductive)] if there]
        return dict(zip(names, seen.x[self.size - len(names) :], strict=True))

    def _resistance(self, seen: Signals) -> Lane:
        """Compute the resistance R at the motor's temperature."""
        R = scalar(self.windings.resistance, seen.dtype)
        if self.heat is None:
            return R
        _, _, ambient, alpha, reference = numbers(self.heat.numbers, seen.dtype)
        return R * (1 + alpha * (self._parts(seen)["T"] + ambient - reference))

    def _voltage(self, seen: Signals, h: Any) -> Lane:
        """Compute the voltage V of a step h."""
        out: Lane = 0.0
        if self.controller is not None:
            w, dtype = self.windings, seen.dtype
            K, R, limit = (scalar(x, dtype) for x in (w.constant, w.resistance, w.drive))
            out = R / K * self.controller.output(seen, h, seen.x) + K * seen.speed
            out = jnp.clip(out, -limit, limit)
        return add(out, seen.u[-1]) if self.voltage else out

    def _current(self, seen: Signals, h: Any) -> Lane:
        """Compute the current i without inductance."""
        K = scalar(self.windings.constant, seen.dtype)
        return (self._voltage(seen, h) - K * seen.speed) / at_least(self._resistance(seen))

    def _current_rate(self, seen: Signals, h: Any) -> Lane:
        """Compute the rate i' of a current with inductance."""
        w, i = self.windings, self._parts(seen)["i"]
        limit = scalar(w.current_rate, seen.dtype)
        te = at_least(scalar(w.time_constant, seen.dtype))
        return jnp.clip((self._current(seen, h) - i) / te, -limit, limit)

    def _current_after(self, seen: Signals, h: Any) -> Lane:
        """Compute the current i after a step h."""
        te = scalar(self.windings.time_constant, seen.dtype)
        rate = self._current_rate(seen, h)
        return self._parts(seen)["i"] + lag_step(h, te, rate * at_least(te))

    def _rates(self, seen: Signals, h: Any) -> list[Lane]:
        out = [] if self.controller is None else self.controller.rate(seen, h)
        x = self._parts(seen)
        if self.heat is not None:
            resistance, capacity, *_ = numbers(self.heat.numbers, seen.dtype)
            i = x["i"] if self.windings.inductive else self._current(seen, h)
            R = self._resistance(seen)
            out.append((R * i * i - x["T"] / resistance) / capacity)
        if self.bristles is not None:
            out.append(self.bristles.rate(x["z"], seen.speed, seen.dtype))
        if self.windings.inductive:
            out.append(self._current_rate(seen, h))
        return out
