"""Numbers that no robot has are refused by name, with what is expected."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.model import State
from rbjax.wheeled import Body, Fiala, Steering, Wheel

KINDS = wheeled.kinds()
LENGTHS = {
    "differential_drive": ("track", "radius"), "unicycle": ("radius",),
    "omni_3": ("arm", "radius"), "omni_4": ("arm", "radius"),
    "mecanum": ("length", "track", "radius"), "car": ("wheelbase", "track", "radius"),
    "front_drive_car": ("wheelbase", "track", "radius"), "bicycle": ("wheelbase", "radius"),
    "tricycle": ("wheelbase", "track", "radius"), "skid_steer": ("length", "track", "radius"),
    "tractor_trailers": ("track", "radius"), "car_trailer": ("wheelbase", "track", "radius"),
}  # fmt: skip


def test_the_table_has_every_kind() -> None:
    assert LENGTHS.keys() == KINDS.keys()


@pytest.mark.parametrize("kind", LENGTHS)
def test_lengths_masses_and_names_of_every_kind(kind: str) -> None:
    for name in LENGTHS[kind]:
        for x in (0.0, -1.0, np.nan, np.inf, "x", [1.0, 2.0], None):
            message = rf"{name} (is|has shape) .*expected a length above"
            with pytest.raises(rb.InputError, match=message):
                KINDS[kind].make(**{name: x})
    for name in ("mass", "inertia", "wheel_mass"):
        with pytest.raises(rb.InputError, match="expected numbers of at least 0"):
            KINDS[kind].make(**{name: -1.0})
    with pytest.raises(rb.UnknownName, match=f"parameter of a {kind} 'nonsense'.*'radius'"):
        KINDS[kind].make(nonsense=1.0)


PARTS: dict[str, Callable] = {
    "Body.mass=.*at least 0": lambda: Body(-1.0),
    "Body.inertia=.*at least 0": lambda: Body(1.0, -1.0),
    "Body.height=.*at least 0": lambda: Body(1.0, 1.0, height=-0.1),
    "Wheel.mass=.*at least 0": lambda: Wheel([0.0, 0.0], mass=-1.0),
    "Wheel.inertia=.*at least 0": lambda: Wheel([0.0, 0.0], inertia=-1.0),
    "Wheel.damping=.*at least 0": lambda: Wheel([0.0, 0.0], damping=-1.0),
    "Wheel.radius=.*numbers above 0": lambda: Wheel([0.0, 0.0], radius=0.0),
    "Steering: lag is 0.0.*above zero": lambda: Steering((0,), 0.0),
    "expected rbjax.wheeled.TorqueSource": lambda: wheeled.Drive((0,), 3.0),
    "at: robot is None": lambda: wheeled.at(None, "reduced"),
    "unknown fidelity 'nope'": lambda: wheeled.at(KINDS["car"].make(), "nope"),
    "unknown fidelity 3": lambda: wheeled.at(KINDS["car"].make(), 3),
    "option of 'reduced' 'tyre'": lambda: wheeled.at(
        KINDS["car"].make(), "reduced", tyre=Fiala(1.0, 1.0)
    ),
}


@pytest.mark.parametrize("message", PARTS)
def test_parts(message: str) -> None:
    with pytest.raises((rb.InputError, rb.UnknownName), match=message):
        PARTS[message]()


def test_a_robot_of_other_parts_has_their_arrangement() -> None:
    """A car whose front wheels are fixed beside the rear ones drives straight and turns."""
    robot = KINDS["differential_drive"].make(caster=None)
    assert robot.arrangement.mobility == 2
    rollers = tuple(w.replace(kind="rollers") for w in robot.wheels)
    assert robot.replace(wheels=rollers).arrangement.mobility == 3
    heavier = robot.replace(gravity=1.6)
    assert heavier.arrangement is robot.arrangement

    def mobility(radius: jax.Array) -> jax.Array:
        wheels = tuple(w.replace(radius=radius) for w in robot.wheels)
        return radius * robot.replace(wheels=wheels).arrangement.mobility

    assert float(jax.jit(mobility)(jnp.asarray(0.5))) == 1.0


def test_a_state_without_tyre_states_keeps_its_dtype() -> None:
    tyre = wheeled.Relaxing(Fiala(20.0, 0.8), 0.1)
    cart = wheeled.at(KINDS["differential_drive"].make(caster=None), "slipping", tyre=tyre)
    assert cart.nx
    full = wheeled.start(cart)
    state = State(full.q.astype(jnp.float32), full.v.astype(jnp.float32))
    found = wheeled.rates(cart, state, jnp.zeros(cart.nu, jnp.float32))
    assert found.q.dtype == found.x.dtype == jnp.float32
