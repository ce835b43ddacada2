"""A free joint in the place of another one counts from the world, or is rejected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError
from tests.tolerances import F64_IDENTITY, relative_error

BODY = """<mujoco><worldbody><body name="b" pos="1 2 3" quat="0.6 0 0.8 0">
<joint name="j" pos="0.1 0.2 0.3" axis="0 1 0"/>{}
<inertial pos="0.1 0 0.2" mass="2" diaginertia="0.1 0.2 0.25"/></body></worldbody>
<keyframe><key name="k" qpos="0.4{}"/></keyframe></mujoco>"""


def test_its_coordinates_are_the_bodys_pose_in_the_world():
    model = rb.load(BODY.format("", "")).with_joint("j", "free")
    p, quat = [0.5, -0.3, 0.2], np.array([0.5, -0.5, 0.1, 0.7])
    quat /= np.linalg.norm(quat)
    R, at = rb.forward_kinematics(model, jnp.array([*p, *quat]))
    np.testing.assert_allclose(at[0], p, atol=1e-14)
    np.testing.assert_allclose(R[0], rb.rotations.quaternion.to_matrix(quat), atol=1e-14)
    falling = rb.forward_dynamics(model, jnp.array([*p, *quat]), jnp.zeros(6), jnp.zeros(6))
    np.testing.assert_allclose(falling, [0, 0, -9.81, 0, 0, 0], atol=1e-12)


def test_it_starts_where_the_file_draws_the_body():
    before = rb.load(BODY.format("", ""))
    model = before.with_joint("j", "free")
    for state in (model.default_state(), model.keyframe("k")):
        np.testing.assert_allclose(state.q, [1, 2, 3, 0.6, 0, 0.8, 0], atol=1e-14)
    want = rb.forward_kinematics(before, before.default_state().q)
    found = rb.forward_kinematics(model, model.default_state().q)
    for a, b in zip(found, want, strict=True):
        assert relative_error(a, b) < F64_IDENTITY
    own = before.with_joint("j", "free", reference=[0.0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(own.default_state().q, [0, 0, 0, 1, 0, 0, 0])


def test_below_a_body_or_beside_another_joint_it_is_rejected():
    with pytest.raises(InputError, match=r"'elbow' joins the body 'lower' to the body 'upper'"):
        rb.load("double_pendulum").with_joint("elbow", "free")
    two = rb.load(BODY.format('<joint name="k" type="slide"/>', " 0"))
    with pytest.raises(InputError, match=r"has the joints \['j', 'k'\], expected 'j' only"):
        two.with_joint("j", "free")


def test_kinds_that_count_from_the_parent_stay():
    ball = rb.load("double_pendulum").with_joint("elbow", "ball")
    assert ball.default_state().q.shape == (5,)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_planar_joint_has_the_frame_of_the_shortest_rotation(dtype):
    """Normals everywhere, -z included; x and y of the joint, and a derivative by the normal."""
    model = rb.load(BODY.format("", "")).replace(keyframes=rb.load("pendulum").keyframes)
    still = model.bodies.replace(position=jnp.zeros((1, 3)), orientation=[[1.0, 0, 0, 0]])
    model = model.replace(bodies=still)
    rng = np.random.default_rng(0)
    for n in [*rng.normal(size=(8, 3)), [0.75**0.5, 0, -0.5], [0, 0, 1], [0, 0, -1], [0, 1, 0]]:
        n = np.asarray(n) / np.linalg.norm(n)
        own = model.with_joint("j", "planar", axis=n).astype(dtype)
        x, y = (rb.forward_kinematics(own, jnp.array(q, dtype)).p[0]
                for q in ([1.0, 0, 0], [0, 1.0, 0]))  # fmt: skip
        c, side = n[2], np.array([n[0], n[1]])
        across = side @ side
        share = (1 - c) / across if across > 1e-12 else 0.0
        want = np.array([[1, 0, 0], [0, 1, 0]], float)
        want[:, :2] -= share * np.outer(side, side)
        want[:, 2] = -side
        if c < -1 + 1e-12:
            want = np.array([[1.0, 0, 0], [0, -1, 0]])
        tolerance = 1e-6 if dtype == jnp.float32 else 1e-12
        np.testing.assert_allclose(np.stack([x, y]), want, atol=tolerance)

    def place(axis):
        own = model.with_joint("j", "planar", axis=[0.0, 0.0, -1.0])
        own = own.replace(joints=own.joints.replace(axis=axis[None]))
        return rb.forward_kinematics(own, jnp.array([0.3, -0.2, 0.4])).p[0]

    slope = jax.jacfwd(place)(jnp.array([0.0, 0.0, -1.0]))
    assert np.isfinite(slope).all()
    for axis in ([0.0, 0.0, -1.0], [0.3, 0.4, -0.8]):
        moved = model.fix_zeros().with_joint("j", "planar", axis=axis)
        q = jnp.array([0.3, -0.2, 0.4])
        plain = model.with_joint("j", "planar", axis=axis)
        found = jax.jit(rb.mass_matrix)(moved, q)
        assert relative_error(found, rb.mass_matrix(plain, q)) < F64_IDENTITY


class Hinge(rb.joints.Node):
    name, coordinates = "hinge", 1

    def pose(self, q, numbers):
        raise AssertionError


def test_a_built_in_kind_is_not_replaced():
    class Nameless(rb.joints.Node):
        coordinates = 1

    with pytest.raises(InputError, match=r"'hinge' is the name of .*Hinge already"):
        rb.joints.register(Hinge())
    with pytest.raises(InputError, match="expected a string"):
        rb.joints.register(Nameless())
    assert type(rb.joints.kind("hinge")) is not Hinge


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_rejected_by_name(dtype):
    model = rb.load("double_pendulum")
    half = jnp.zeros(2, dtype)
    for call in (
        lambda: model.astype(dtype),
        lambda: rb.mass_matrix(model, half),
        lambda: rb.rollout(model, rb.State(half, half), None, 0.01, steps=2),
        lambda: rb.rotations.so3.exp(jnp.zeros(3, dtype)),
        lambda: rb.integrate(model, jnp.zeros(2), half),
    ):
        with pytest.raises(InputError, match="expected float32 or float64"):
            call()
