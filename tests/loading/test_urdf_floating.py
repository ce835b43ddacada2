"""Floating joints anywhere in a URDF, and roots named 'world'."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.loading.test_inertials import error_beside_pinocchio, link
from tests.loading.test_load import joint, urdf
from tests.tolerances import F64_PARITY, relative_error

WORLD = '<link name="world"/>'
ARM = (link("base"), link("arm"), joint("turn", "base", "arm", "continuous"))
FLY = (link("fly", 0.7), joint("float", "arm", "fly", "floating"))


def test_below_a_moving_link_a_body_flies_on_its_own() -> None:
    """Only gravity acts on it, and it acts on nothing."""
    model, alone = rb.load(urdf(*ARM, *FLY)), rb.load(urdf(*ARM))
    assert model.topology.joint_kinds == ("hinge", "slide", "slide", "slide", "ball")
    assert model.joint_names[1:] == ("float_TX", "float_TY", "float_TZ", "float_R")
    state = model.random_state(jax.random.key(0))

    def rates(q, v):
        a = rb.forward_dynamics(model, q, v, jnp.zeros(model.nv))
        com = model.bodies.com[model.body("fly")]
        J = rb.jacobian(model, q, "fly", com)
        moved = J @ a + rb.frame_bias_acceleration(model, q, v, "fly", com)
        R = rb.forward_kinematics(model, q).R[model.body("fly")]
        return a, moved, J @ v, R

    a, moved, V, R = jax.jit(rates)(state.q, state.v)
    want = rb.forward_dynamics(alone, state.q[:1], state.v[:1], jnp.zeros(1))
    assert relative_error(a[:1], want) <= F64_PARITY
    assert relative_error(moved[3:], model.gravity) <= F64_PARITY
    I = R @ model.bodies.inertia[model.body("fly")] @ R.T
    euler = I @ moved[:3] + jnp.cross(V[:3], I @ V[:3])
    assert np.abs(euler).max() <= F64_PARITY


def test_it_rests_where_the_joint_is() -> None:
    model = rb.load(urdf(*ARM, *FLY))
    fixed = rb.load(urdf(*ARM, FLY[0], joint("float", "arm", "fly", "fixed")))
    poses = [rb.forward_kinematics(m, m.default_state().q) for m in (model, fixed)]
    for a, b in zip(*map(jax.tree.leaves, poses), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_below_a_root_at_rest_it_is_a_free_joint() -> None:
    """As under a root named 'world', and as Pinocchio has it."""
    floats = joint("float", "base", "fly", "floating")
    floats = floats.replace('<origin xyz="0 0 1" rpy="0.1 0.2 0.3"/>', "")
    hand = (link("hand"), joint("wrist", "fly", "hand", "continuous"))
    text = urdf(link("base"), FLY[0], floats, *hand)
    model = rb.load(text)
    assert model.topology.joint_kinds == ("free", "hinge")
    assert "base" in model.body_names
    assert error_beside_pinocchio(text) <= F64_PARITY


def test_several_floats_and_a_floating_base() -> None:
    far = (link("far"), joint("further", "fly", "far", "floating"))
    model = rb.load(urdf(*ARM, *FLY, *far), floating_base=True)
    assert model.nv == 6 + 1 + 6 + 6
    state = model.random_state(jax.random.key(1))
    assert jnp.isfinite(rb.forward_dynamics(model, state.q, state.v, jnp.zeros(model.nv))).all()


# ---------------------------------------------------------------------------- roots named 'world'


@pytest.mark.parametrize("heavy", ["world", "base"])
def test_a_world_with_mass_floats_under_another_name(heavy: str) -> None:
    weld = joint("weld", "world", "base", "fixed")
    first = link("world") + '<link name="base"/>' if heavy == "world" else WORLD + ARM[0]
    text = urdf(first, weld, *ARM[1:])
    model = rb.load(text, floating_base=True)
    assert model.topology.joint_kinds == ("free", "hinge")
    assert model.body_names == ("world_link", "base", "arm")
    assert error_beside_pinocchio(text, floating_base=True) <= F64_PARITY


def test_what_floats_on_the_world_already_floats_once() -> None:
    text = urdf(WORLD, *ARM, joint("float", "world", "base", "floating"))
    model, plain = rb.load(text, floating_base=True), rb.load(text)
    assert model.joint_names == plain.joint_names == ("float", "turn")


def test_a_link_named_world_elsewhere_is_renamed() -> None:
    text = urdf(*ARM, link("world"), joint("weld", "arm", "world", "fixed"))
    for floating in (False, True):
        model = rb.load(text, floating_base=floating)
        assert model.body_names[-1] == "world_link"
        assert float(model.bodies.mass[-1]) == 1.5


# ---------------------------------------------------------------------------- what cannot move


def test_joints_that_undo_each_other_are_refused_by_name() -> None:
    """A base without mass and one joint: turning the base back is as turning the joint."""
    text = urdf('<link name="base"/>', *ARM[1:])
    assert rb.load(text).nv == 1
    with pytest.raises(rb.ModelError, match=r"together move no mass: floating_base, turn;"):
        rb.load(text, floating_base=True)
    other = (link("other"), joint("more", "base", "other", "continuous"))
    tilted = other[1].replace("0 1 0", "1 0 0")
    assert rb.load(urdf('<link name="base"/>', *ARM[1:], other[0], tilted), floating_base=True).nv
