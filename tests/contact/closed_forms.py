"""Scenes with closed forms: bodies on planes, each with contact parameters of its own."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.model import State

G = 9.81
#: slides along x and z
PLANAR = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
#: slides along x and z, and a hinge about y
ROLLING = PLANAR + '<joint type="hinge" axis="0 1 0"/>'
#: impedance that is constant
STIFF = "0.9 0.9 0.001 0.5 2"


class Touch(NamedTuple):
    """Parameters of the contact of a body with its floor, as in a file."""

    friction: float = 1e-5
    solref: str = "0.02 1"
    solimp: str = STIFF
    solreffriction: str = "0 0"
    condim: int = 3


class Body(NamedTuple):
    """A body at a height over a plane of its own, which is inclined about y.

    Fields:
        touch: parameters of the contact.
        joints: of the body, along the axes of the plane.
        geom: shape and mass of the body.
        height: of the body over the plane, m.
        slope: angle about y in rad; a positive one lets the body go to +x.
    """

    touch: Touch
    joints: str = PLANAR
    geom: str = 'type="sphere" size="0.1" mass="1"'
    height: float = 0.1
    slope: float = 0.0


def load(bodies: Sequence[Body], **option: Any) -> rb.Model:
    """Load bodies that each touch their own plane only. Joints are along the plane's axes."""
    world, pairs = "", ""
    off = 'contype="0" conaffinity="0"'
    for k, body in enumerate(bodies):
        angle = f'euler="0 {body.slope} 0" pos="0 {k} 0"'
        up = f"{body.height * np.sin(body.slope)} {k} {body.height * np.cos(body.slope)}"
        world += f'<geom name="floor{k}" type="plane" size="0 0 1" {angle} {off}/>'
        world += f'<body pos="{up}" euler="0 {body.slope} 0">{body.joints}'
        world += f'<geom name="geom{k}" {body.geom} {off}/></body>'
        t = body.touch
        pairs += (
            f'<pair geom1="floor{k}" geom2="geom{k}" condim="{t.condim}" solref="{t.solref}" '
            f'solimp="{t.solimp}" solreffriction="{t.solreffriction}" '
            f'friction="{t.friction} {t.friction} 0.005 0.0001 0.0001"/>'
        )
    return load_text(world, pairs, **option)


def load_text(world: str, pairs: str = "", **option: Any) -> rb.Model:
    """Load a world body and explicit pairs. option: attributes of the file's option."""
    text = " ".join(f'{name}="{x}"' for name, x in ({"cone": "elliptic"} | option).items())
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*left out of the model")
        return rb.load(
            f'<mujoco><compiler angle="radian"/><option {text}/><worldbody>{world}</worldbody>'
            f"<contact>{pairs}</contact></mujoco>",
            contacts=True,
        )


def mover(model: rb.Model, contact: Any = None, tau: Any = None) -> Any:
    """Return the compiled function (v, dt, steps) -> the state after some steps from rest at the
    model's default configuration with the velocity v; tau(t) are forces."""

    @jax.jit
    def run(v: jax.Array, dt: jax.Array, steps: jax.Array) -> State:
        start = model.default_state().replace(v=v)
        law = rb.contact.laws()[contact or "mujoco"](model)
        if hasattr(law, "initial_memory"):
            start = start.replace(memory=law.initial_memory(model))

        def step(i: jax.Array, state: State) -> State:
            force = None if tau is None else tau(i * dt)
            return rb.step(model, state, dt=dt, tau=force, contact=contact)

        return jax.lax.fori_loop(0, steps, step, start)

    return lambda v, dt, time: run(jnp.asarray(v, float), dt, round(time / dt))
