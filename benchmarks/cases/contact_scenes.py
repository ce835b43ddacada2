"""Scenes of contact with known motions of rigid bodies, for the map of contact laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

G = 9.81
SLIDE_X, SLIDE_Y, SLIDE_Z = (
    f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1")
)
FLOOR = '<geom type="plane" size="0 0 1"/>'


@dataclass(frozen=True)
class Scene:
    """A scene with a measure of the error.

    title: of the column and the panel.
    xml: the bodies, with `default` as the default geom.
    start: (q, v).
    time: duration, s.
    weight: N, on the lowest contact, which sets the stiffness of compliant contacts.
    error: (t, q, v) -> (), m, the deviation from the rigid motion at a time.
    at_end: whether only the error at the end counts, or the largest one.
    """

    title: str
    xml: str
    default: str
    start: tuple[Any, Any]
    time: float
    weight: float
    error: Callable[[Any, jax.Array, jax.Array], jax.Array]
    at_end: bool = False

    def model(self) -> rb.Model:
        return rb.load(
            f"<mujoco><default><geom {self.default}/></default><worldbody>{FLOOR}{self.xml}"
            "</worldbody></mujoco>"
        )


def body(height: float, joints: str, geom: str) -> str:
    return f'<body pos="0 0 {height}">{joints}<geom {geom}/></body>'


HEIGHT, SPEED, FRICTION = 0.05, 2.0, 0.5
DISC, SPIN, GRIP = 0.1, 10.0, 0.3
HALF, ANGLE, BALL, SLIP = 0.5, float(np.arctan(2.0)), 0.01, 2.0
LIFTED = HALF * float(np.sin(ANGLE))


def rigid_drop(t: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """A plastic impact: free fall, then rest on the floor."""
    return jnp.abs(q[0] - jnp.maximum(-0.5 * G * t * t, -HEIGHT))


def stopping_distance(t: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    return jnp.abs(jnp.hypot(q[0], q[1]) - SPEED**2 / (2 * FRICTION * G))


def displacement(t: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    return jnp.abs(q).max()


def turned_arc(t: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """A disc on an axle that rests on its rim: the friction mu m g at the rim stops its spin."""
    return jnp.abs(DISC * q[1] - (DISC * SPIN) ** 2 / (4 * GRIP * G))


def depth_or_lift(t: Any, q: jax.Array, v: jax.Array) -> jax.Array:
    """Penetration of the tip of the rod, or its gain of energy as a height."""
    tip = LIFTED + q[1] + HALF * jnp.sin(q[2])
    energy = 0.5 * (v[0] ** 2 + v[1] ** 2 + HALF**2 / 3 * v[2] ** 2) - 0.5 * SLIP**2
    return jnp.maximum(jnp.maximum(-tip, energy / G + q[1]), 0.0)


SCENES = {
    "stiffness": Scene(
        "drop on a stiff floor", body(0.1 + HEIGHT, SLIDE_Z, 'size="0.1" mass="1"'),
        'solref="0.004 1" solimp="0.99 0.999 0.001 0.5 2"', ([0.0], [0.0]), 0.3, G, rigid_drop,
    ),
    "friction": Scene(
        "friction: distance of a slide",
        body(0.1, SLIDE_X + SLIDE_Y + SLIDE_Z, 'size="0.1" mass="1"'),
        f'friction="{FRICTION}"',
        ([0.0] * 3, [SPEED * np.sqrt(0.5), SPEED * np.sqrt(0.5), 0.0]), 0.6, G, stopping_distance,
        True,
    ),
    "stack": Scene(
        "stack of three boxes",
        "".join(
            body(z, f'{SLIDE_X}{SLIDE_Z}<joint axis="0 1 0"/>',
                 'type="box" size="0.1 0.1 0.1" mass="1"')
            for z in (0.1, 0.3, 0.5)
        ), 'friction="0.8"', ([0.0] * 9, [0.0] * 9), 0.5, 3 * G, displacement,
    ),
    "spin": Scene(
        "spin of a disc on an axle",
        body(0.02, f'{SLIDE_Z}<joint axis="0 0 1"/>',
             f'type="cylinder" size="{DISC} 0.02" mass="1"'),
        f'friction="{GRIP}"', ([0.0] * 2, [0.0, SPIN]), 0.3, G, turned_arc, True,
    ),
    "painleve": Scene(
        "Painlevé's rod, friction 2",
        f'<body pos="0 0 {LIFTED + BALL}">{SLIDE_X}{SLIDE_Z}<joint axis="0 1 0"/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="1 {HALF**2 / 3} 1"/>'
        f'<geom size="{BALL}" pos="-{HALF} 0 0"/></body>',
        'friction="2"', ([0.0, 0.0, -ANGLE], [-SLIP, 0.0, 0.0]), 0.15, G, depth_or_lift,
    ),
    "mass_ratio": Scene(
        "1,000 kg on 1 kg",
        body(0.1, SLIDE_Z, 'size="0.1" mass="1"') + body(0.3, SLIDE_Z, 'size="0.1" mass="1000"'),
        "", ([0.0] * 2, [0.0] * 2), 0.5, 1001 * G, displacement,
    ),
}  # fmt: skip
