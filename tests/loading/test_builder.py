"""Robots built by calls: against files, and against the robot itself with a joint at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.loading.test_load import load_quietly
from tests.tolerances import F64_PARITY, relative_error

INERTIA = np.array([[0.3, 0.01, 0.02], [0.01, 0.4, 0.03], [0.02, 0.03, 0.5]])
FILE = """<mujoco><compiler angle="radian"/><option gravity="0 0 -3" timestep="0.005"/><worldbody>
  <body name="a" pos="0.1 0.2 0.3" quat="0.6 0.8 0 0">
    <inertial pos="0.1 0 0" mass="2" fullinertia="0.3 0.4 0.5 0.01 0.02 0.03"/>
    <joint name="x" type="slide" axis="1 2 0" damping="0.5"/>
    <joint name="turn" axis="0 1 1" pos="0.1 0 0.2" range="-1 2" ref="0.3" armature="0.1"/>
    <geom name="ball" size="0.1" pos="0 0 0.1" friction="0.3 0.01 0.001"/>
    <body name="b" pos="0 0 1">
      <inertial pos="0 0.1 0" mass="1" fullinertia="0.3 0.4 0.5 0.01 0.02 0.03"/>
      <joint name="free" type="ball"/>
      <site name="tip" pos="0 0 0.5" quat="0 1 0 0"/>
    </body>
  </body></worldbody>
  <actuator><motor name="m" joint="turn" gear="3" ctrlrange="-1 1"/></actuator></mujoco>"""


def builder() -> rb.ModelBuilder:
    out = rb.ModelBuilder(gravity=[0, 0, -3], timestep=0.005)
    out.add_body(
        "a", position=[0.1, 0.2, 0.3], orientation=[0.6, 0.8, 0, 0], mass=2.0, com=[0.1, 0, 0],
        inertia=INERTIA,
    )  # fmt: skip
    out.add_joint("x", "a", "slide", axis=[1, 2, 0], damping=0.5)
    out.add_joint(
        "turn", "a", axis=[0, 1, 1], position=[0.1, 0, 0.2], range=[-1, 2], ref=0.3, armature=0.1
    )
    out.add_geom("ball", "a", "sphere", 0.1, position=[0, 0, 0.1], friction=[0.3, 0.01, 0.001])
    out.add_body("b", "a", position=[0, 0, 1], mass=1.0, com=[0, 0.1, 0], inertia=INERTIA)
    out.add_joint("free", "b", "ball")
    out.add_site("tip", "b", position=[0, 0, 0.5], orientation=[0, 1, 0, 0])
    out.add_motor("m", "turn", gear=3.0, ctrlrange=[-1, 1])
    return out


def quietly(b: rb.ModelBuilder) -> rb.Model:
    return b.build(limits=True)


def test_a_built_robot_is_that_of_a_file() -> None:
    model, read = quietly(builder()), rb.load(FILE, limits=True)
    assert jax.tree.structure(model) == jax.tree.structure(read)
    for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(read), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


LOCKED = [("x", [0.7]), ("turn", [1.1]), ("free", [0.6, 0, 0.8, 0])]


@pytest.mark.parametrize(("joint", "q"), LOCKED)
def test_a_locked_joint_is_a_joint_at_rest(joint: str, q: list) -> None:
    whole = quietly(builder())
    b = builder()
    b.lock(joint, q)
    model = quietly(b)
    at = whole.q_slice(joint)
    state = whole.random_state(jax.random.key(0))
    full = state.q.at[at].set(jnp.asarray(q))
    rest = jnp.delete(full, jnp.arange(at.start, at.stop), assume_unique_indices=True)
    assert joint not in model.joint_names and model.nu == (0 if joint == "turn" else 1)
    keep = np.delete(np.arange(whole.nv), np.arange(whole.nv)[whole.v_slice(joint)])
    M = rb.mass_matrix(whole, full)[np.ix_(keep, keep)]
    assert relative_error(rb.mass_matrix(model, rest), M) <= F64_PARITY


def test_robots_are_attached_with_their_actuators() -> None:
    b = rb.ModelBuilder("arm7")
    b.attach("gripper", load_quietly("arm7").body_names[-1], prefix="hand_", position=[0, 0, 0.1])
    arm, hand, both = load_quietly("arm7"), load_quietly("gripper"), load_both(b)
    assert both.nv == arm.nv + hand.nv and both.nu == arm.nu + hand.nu
    assert both.actuator_names[arm.nu :] == tuple(f"hand_{n}" for n in hand.actuator_names)
    assert len(both.geoms.types) == len(arm.geoms.types) + len(hand.geoms.types) - 1  # no floor


def load_both(b: rb.ModelBuilder) -> rb.Model:
    return load_quietly(b.spec.copy())


def test_a_model_is_attached_with_its_numbers() -> None:
    model = rb.load("pendulum")
    heavy = model.replace(bodies=model.bodies.replace(mass=3 * model.bodies.mass))
    b = rb.ModelBuilder()
    b.attach(heavy, prefix="one_")
    b.attach(heavy, prefix="two_", position=[0, 1, 0])
    found = b.build()
    np.testing.assert_allclose(found.bodies.mass, np.repeat(heavy.bodies.mass, 2), rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda b: b.add_body("c", "none"), "body"),
        (lambda b: b.add_joint("j", "a", "screw"), "kind of joint"),
        (lambda b: b.add_joint("j", "a", stretch=1.0), "parameter of a joint"),
        (lambda b: b.add_joint("j", "a", axis=[1, 0]), "axis has 2 numbers, expected 3"),
        (lambda b: b.add_body("c", mass=1.0, inertia=np.ones((2, 2))), r"\(2, 2\)"),
        (lambda b: b.lock("none"), "joint"),
    ],
)  # fmt: skip
def test_wrong_calls_are_named(call, words: str) -> None:
    with pytest.raises((rb.InputError, rb.UnknownName), match=words):
        call(builder())
