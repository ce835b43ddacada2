"""Wrenches in joints: at the world as at a body, of rigid rows and of soft ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc

ROD = rb.load(
    '<mujoco><worldbody><body name="rod"><freejoint/>'
    '<inertial pos=".5 0 0" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>'
)
WEIGHT = 2 * 9.81
#: f32 solves the rows to 1e-6 or so of the weight
ATOL = {jnp.float64: 1e-9, jnp.float32: 1e-3}


def wrenches(model: rb.Model, dtype: type) -> np.ndarray:
    state = jax.tree.map(lambda x: x.astype(dtype), model.default_state())
    return np.asarray(rc.joint_wrenches(model, state))


@pytest.mark.parametrize("dtype", ATOL)
@pytest.mark.parametrize("ends", [(None, "rod"), ("rod", None)])
def test_supports_at_the_world(ends: tuple, dtype: type) -> None:
    """Two balls carry a rod, whichever end is called b."""
    balls = [rc.Spherical.between(ROD, *ends, point=[x, 0, 0]) for x in (0.0, 1.0)]
    found = wrenches(ROD.with_constraints(*balls), dtype)
    up = WEIGHT / 2 if ends[1] == "rod" else -WEIGHT / 2
    np.testing.assert_allclose(found, [[0, 0, 0, 0, 0, up]] * 2, rtol=0, atol=ATOL[dtype])


KINDS = {
    "Revolute": {}, "Cylindrical": {}, "Prismatic": {}, "Screw": {"pitch": 0.2}, "Planar": {},
    "Universal": {}, "Weld": {}, "Inline": {}, "Inplane": {}, "Parallel": {}, "Orthogonal": {},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_acts_on_the_world_as_on_a_body(kind: str) -> None:
    action_and_reaction(kind, KINDS[kind])


def test_action_and_reaction() -> None:
    action_and_reaction("Weld", {})


def action_and_reaction(kind: str, numbers: dict) -> None:
    """With the ends exchanged the wrench has the other sign: their frames are the same one."""
    out = []
    for a, b in ((None, "rod"), ("rod", None)):
        joint = rc.kinds()[kind].between(
            ROD, a, b, point=[0.2, 0.1, 0.0], axis=[1, 2, 3], **numbers
        )
        out.append(wrenches(ROD.with_constraints(joint), jnp.float64)[0])
    assert np.abs(out[0]).max() > 0.1 or kind in ("Parallel", "Orthogonal")
    if kind not in ("Universal", "Orthogonal"):  # which name an axis of a and another one of b
        np.testing.assert_allclose(out[0], -out[1], rtol=0, atol=1e-9)


def test_a_weld_carries_weight_and_moment() -> None:
    weld = rc.Weld.between(ROD, "rod", None)
    found = wrenches(ROD.with_constraints(weld), jnp.float64)
    due = [0, WEIGHT * 0.5, 0, 0, 0, -WEIGHT]  # on the world
    np.testing.assert_allclose(found, [due], rtol=0, atol=1e-9)


def test_no_joints_and_both_ends_on_one_link() -> None:
    assert rc.joint_wrenches(ROD, ROD.default_state()).shape == (0, 6)
    two = rb.load(
        '<mujoco><worldbody><body name="a"><freejoint/><geom size=".1"/><body name="b"/></body>'
        "</worldbody></mujoco>"
    )
    ball = rc.Spherical.between(two, "a", "b")
    found = wrenches(two.with_constraints(ball), jnp.float64)
    np.testing.assert_allclose(found, np.zeros((1, 6)), rtol=0, atol=1e-9)


def test_a_user_s_joint_that_pushes_at_a_point() -> None:
    """The wrench is that at the origin of b's frame, where a row pushes elsewhere."""

    class Tip(rc.Pair):
        size = 3

        def between_frames(self, A, B, context):
            return rc.displacement(A, B.at([0.0, 0.0, 0.5]))

    joint = Tip(rc.Place.on(point=[0.5, 0.0, 0.5]), rc.Place.on(body="rod", point=[0.5, 0.0, 0.0]))
    found = wrenches(ROD.with_constraints(joint), jnp.float64)
    np.testing.assert_allclose(found, [[0, 0, 0, 0, 0, WEIGHT]], rtol=0, atol=1e-9)
    turned = joint.replace(b=rc.Place.on(body="rod", point=[0.5, 0.0, 0.0], axis=[1.0, 0.0, 0.0]))
    turned = turned.replace(a=rc.Place.on(point=[1.0, 0.0, 0.0]))
    found = wrenches(ROD.with_constraints(turned), jnp.float64)[0]
    np.testing.assert_allclose(found[1], -0.5 * found[5], rtol=0, atol=1e-9)  # r x f


SOFT = """<mujoco><worldbody><body name="a"><joint name="j" type="slide" axis="0 0 1"/>
  <geom size=".1" mass="1"/></body></worldbody>
  <equality>{}</equality></mujoco>"""


@pytest.mark.parametrize("dtype", ATOL)
def test_soft_rows_have_the_forces_of_the_rollout(dtype: type) -> None:
    row = '<joint joint1="j" polycoef="0 0 0 0 0" solref="0.1 1"/>'
    model = rb.load(SOFT.format(row), compliant=True)
    state = rb.State(jnp.asarray([0.05], dtype), jnp.asarray([0.2], dtype))
    step = 1e-3
    path = rb.rollout(model, state, None, step, steps=1)
    a = (path.v[1] - path.v[0]) / step
    found = rc.constrained_dynamics(model, state.q, state.v, rb.applied_forces(model, state))
    np.testing.assert_allclose(found.acceleration, a, rtol=5e-4 if dtype == jnp.float32 else 1e-9)
    # m a = f - m g
    mass = float(rb.mass_matrix(model, state.q)[0, 0])
    np.testing.assert_allclose(rc.multipliers(model, state), mass * (a + 9.81), rtol=1e-3)
    np.testing.assert_allclose(found.multipliers, rc.multipliers(model, state), rtol=1e-6)


def test_soft_joints_have_wrenches() -> None:
    """At rest under its weight a soft ball carries it, as a rigid one does."""
    connect = '<connect body1="a" anchor="0 0 0" solref="0.02 1"/>'
    model = rb.load(SOFT.format(connect), compliant=True)
    rest = rb.simulate(model, model.default_state(), jnp.linspace(0.0, 2.0, 3)).state(-1)
    found = np.asarray(rc.joint_wrenches(model, rest))
    np.testing.assert_allclose(found[0, 3:], [0, 0, -9.81], rtol=0, atol=1e-6)
