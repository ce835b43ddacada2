"""Actuators without a state: affine in control, length and speed.

    tau = moment^T f,   f = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l')
(MuJoCo, *Computation*, actuation model.) The numbers are the model's own: model.actuators.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.forces.actuators.transmissions import Reach, halves, joint_reach
from rbjax.forces.element import Element, Loads
from rbjax.forces.instant import Instant
from rbjax.lanes import Lane, add, inner, is_literal, is_zero, mul, neg
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.spatial import Force


class Actuators(Element):
    """The actuators of `model.actuators`, one a row, at joints and at sites."""

    @property
    def actuates(self) -> bool:
        return True

    def loads(self, now: Instant) -> Loads:
        model, dtype = now.model, now.v.dtype
        actuators = model.actuators
        gain, bias = table(actuators.gain, dtype), table(actuators.bias, dtype)
        ctrlrange = table(actuators.ctrlrange, dtype)
        forcerange = table(actuators.forcerange, dtype)
        out: dict[int, Lane] = {}
        for i in range(model.nu):
            reach = _reach(now, i)
            if not reach.arms:
                continue
            affine = (1.0, reach.length, reach.speed(now))
            strength = inner((lane(gain[:, k], i) for k in range(3)), affine)
            offset = inner((lane(bias[:, k], i) for k in range(3)), affine)
            force = add(mul(strength, clip(now.u[i], ctrlrange, i)), offset)
            force = clip(force, forcerange, i)
            for n, arm in reach.arms.items():
                out[n] = add(out.get(n, 0.0), mul(arm, force))
        return Loads(out)

    def chord(self, now: Instant, h: Any) -> dict[int, Lane]:
        """Of servos and dampers at joints whose coordinates add, as those of an attitude do not; of
        one at the end of its force range none."""
        model, dtype = now.model, now.v.dtype
        actuators, top = model.actuators, model.topology
        gain, bias = table(actuators.gain, dtype), table(actuators.bias, dtype)
        ctrlrange = table(actuators.ctrlrange, dtype)
        limits = table(actuators.forcerange, dtype)
        out: dict[int, Lane] = {}
        for i, j in enumerate(actuators.joints):
            rows = [[lane(x[:, k], i) for k in range(3)] for x in (gain, bias)]
            sloped = not all(is_zero(x) for row in rows for x in row[1:])
            if not sloped or j < 0 or top.joints[j].quaternion:
                continue
            u, reach = clip(now.u[i], ctrlrange, i), _reach(now, i)
            c, k, d = (add(mul(g, u), b) for g, b in zip(*rows, strict=True))
            own = neg(add(mul(h / 2, d), mul(h * h / 4, k)))
            force = add(c, add(mul(k, reach.length), mul(d, reach.speed(now))))
            own = jnp.where(clip(force, limits, i) == force, jnp.maximum(own, 0.0), 0.0)
            for n, arm in reach.arms.items():
                out[n] = add(out.get(n, 0.0), mul(mul(arm, arm), own))
        return out


def clip(x: Lane, limits: Any, i: int) -> Lane:
    """x within row i of the limits (n, 2); untouched where these are known to be infinite."""
    low, high = lane(limits[:, 0], i), lane(limits[:, 1], i)
    if is_literal(low) and np.isneginf(low) and np.isposinf(high):
        return x
    return jnp.clip(x, jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype))


def _reach(now: Instant, i: int) -> Reach:
    """Length and moment arms of actuator i."""
    actuators = now.model.actuators
    joint, site = actuators.joints[i], actuators.sites[i]
    gear = table(actuators.gear, now.q.dtype)
    g = [lane(gear[:, k], i) for k in range(6)]
    if site >= 0:
        force, torque = halves(g)
        arms = now.site(site).arms(Force(torque, force))
        return Reach(0.0, {n: arm for n, arm in arms.items() if not is_zero(arm)})
    return joint_reach(now, joint, g) if joint >= 0 else Reach(0.0, {})
