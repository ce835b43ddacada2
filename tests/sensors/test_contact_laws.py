"""Sensors that read the forces of each contact law."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb

G = 9.81
LAWS = ("mujoco", "coulomb", "impulse")
#: a box whose plate touches the floor, and whose upper part carries a body by a connect
TOWER = """<mujoco><option timestep=".002"/><worldbody>
<geom name="floor" type="plane" size="0 0 1"/>
<body name="base" pos="0 0 .1"><joint type="slide" axis="0 0 1"/>
  <geom name="plate" type="box" size=".1 .1 .1" mass="1"/>
  <site name="under" type="box" size=".2 .2 .2" pos="0 0 -.1"/>
  <body name="upper" pos="0 0 .1"><inertial pos="0 0 .05" mass="3" diaginertia=".01 .01 .01"/>
    <site name="seam"/></body></body>
<body name="load" pos="0 0 .3"><joint type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="2"
  diaginertia=".01 .01 .01"/></body></worldbody>
<equality><connect body1="upper" body2="load" anchor="0 0 .1"/></equality><sensor>
<touch name="touch" site="under"/>
<contact name="net" geom1="floor" geom2="plate" data="found force" reduce="netforce"/>
<force name="force" site="seam"/><torque name="torque" site="seam"/>
<accelerometer name="acc" site="seam"/></sensor></mujoco>"""


@pytest.mark.parametrize("law", LAWS)
def test_a_tower_at_rest(law: str) -> None:
    """The floor carries 6 kg, and the seam 5 kg, along a trajectory and at its end."""
    model = rb.load(TOWER)
    path = rb.rollout(model, model.default_state(), None, steps=400, contact=law)
    found = rb.sense(model, path, named=True, contact=law)
    assert found["force"].shape == (401, 3)
    end = {name: np.asarray(x[-1]) for name, x in found.items()}
    np.testing.assert_allclose(end["touch"], [6 * G], rtol=1e-3)
    np.testing.assert_allclose(end["net"], [4, 0, 0, 6 * G], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(end["force"], [0, 0, 5 * G], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(end["torque"], 0.0, atol=1e-3)
    np.testing.assert_allclose(end["acc"], [0, 0, G], rtol=1e-3, atol=1e-3)
    # the law of the model is read alike, and so is the law by its own solution
    again = rb.sense(model.replace(contact=law), path.state(-1), named=True)
    for name, x in again.items():
        np.testing.assert_allclose(x, end[name], rtol=1e-9, atol=1e-9)
    solved = rb.contact.solve(model, path.state(-1), contact=law)
    np.testing.assert_allclose(solved.contacts.world_force.sum(0), end["net"][1:], rtol=1e-9)


def test_rigid_constraints_under_impulses() -> None:
    """A rigid connect carries the load as a soft one does."""
    model = rb.load(TOWER)
    rigid = model.replace(constraints=tuple(x.of for x in model.constraints), contact="impulse")
    path = rb.rollout(rigid, rigid.default_state(), None, steps=20)
    found = rb.sense(rigid, path, named=True)
    np.testing.assert_allclose(found["force"][-1], [0, 0, 5 * G], rtol=1e-6, atol=1e-6)
    solved = rb.contact.solve(rigid, path.state(-1), contact="impulse")
    assert solved.forces_of("equality").shape == (3,)
    np.testing.assert_allclose(np.abs(solved.forces_of("equality")).max(), 2 * G, rtol=1e-6)


SLIDER = """<mujoco><option timestep=".002"/><worldbody>
<geom type="plane" size="0 0 1" friction=".25"/>
<body pos="0 0 .1"><joint name="x" type="slide" axis="1 0 0" range="-1 0" limited="true"/>
<joint type="slide" axis="0 0 1"/><geom type="box" size=".1 .1 .1" mass="2" friction=".25"/>
<site name="mid"/></body></worldbody><sensor><jointlimitfrc name="stop" joint="x"/>
<accelerometer name="acc" site="mid"/><touch name="touch" site="mid"/></sensor></mujoco>"""


def up_without_friction(steps: int) -> np.ndarray:
    """The vertical accelerometer of the block by MuJoCo, if the contact has no friction."""
    frictionless = SLIDER.replace("friction=", 'condim="1" friction=')
    model = mujoco.MjModel.from_xml_string(frictionless)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [-0.5, 0.0], [-0.3, 0.0]
    found = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        found.append(data.sensor("acc").data[2])
    return np.array(found)


@pytest.mark.parametrize("law", LAWS)
def test_a_slide_and_a_limit(law: str) -> None:
    """A block slides with mu N / m, and is then pushed by 15 N against its limit."""
    model = rb.load(SLIDER).replace(contact=law)
    state = model.default_state().replace(q=jnp.array([-0.5, 0.0]), v=jnp.array([-0.3, 0.0]))
    path = rb.rollout(model, state, None, steps=40)
    found = rb.sense(model, path, named=True)
    forward, _, up = np.asarray(found["acc"]).T
    np.testing.assert_allclose(forward[20:40], 0.25 * up[20:40], rtol=1e-3)
    if law == "impulse":
        np.testing.assert_allclose(up[20:40], G, rtol=1e-9)
    if law == "coulomb":  # its soft floor still settles, as MuJoCo's does without friction
        np.testing.assert_allclose(up[:40], up_without_friction(40), rtol=1e-9)
    state = model.default_state()
    state = rb.rollout(model, state, None, steps=400, tau=jnp.array([15.0, 0.0])).state(-1)
    end = rb.sense(model, state, tau=jnp.array([15.0, 0.0]), named=True)
    solved = rb.contact.solve(model, state, tau=jnp.array([15.0, 0.0]), contact=law)
    np.testing.assert_allclose(end["stop"], [-solved.limit[0]], rtol=1e-9)
    rubbing = float(solved.contacts.world_force.sum(0)[0])
    np.testing.assert_allclose(end["stop"][0] - rubbing, 15.0, rtol=1e-3)


def test_an_impact_over_a_step() -> None:
    """A plastic impact in 1 ms: the impulse m w is read as the force m w / h, with derivatives, in
    a batch and in f32; a custom law of steps without forces has an acceleration too."""
    ball = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1">
    <joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/><site name="c" size=".2"/></body>
    </worldbody><sensor><touch site="c"/><accelerometer site="c"/></sensor></mujoco>"""
    model, h = rb.load(ball), 1e-3
    law = rb.contact.MoreauContact.of(model, pairs=[(1, 0)])  # in the other order than the file's
    state = model.default_state()

    def read(v, model=model, state=state, **how):
        return rb.sense(model, state.replace(v=v), dt=h, **how)

    due = np.array([2 * (3.0 + G * h) / h, 0, 0, 3.0 / h + G])
    v = jnp.array([-3.0])
    np.testing.assert_allclose(read(v, contact=law), due, rtol=1e-12)
    np.testing.assert_allclose(read(v, contact="impulse"), due, rtol=1e-12)
    many = jax.vmap(lambda v: read(v, contact="impulse"))(jnp.array([[-3.0], [3.0]]))
    np.testing.assert_allclose(many, [due, [0, 0, 0, 0]], rtol=1e-12, atol=1e-12)
    rate = jax.jit(jax.jacrev(lambda v: read(v, contact="impulse")))(v)
    np.testing.assert_allclose(rate[:, 0], [-2 / h, 0, 0, -1 / h], rtol=1e-9)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (model, state))
    x = read(v.astype(jnp.float32), *single, contact="impulse")
    assert x.dtype == jnp.float32
    np.testing.assert_allclose(x, due, rtol=1e-5)

    class Halving:
        """The velocity halves in each step."""

        def initial_memory(self, model):
            return jnp.zeros(1)

        def advance_velocity(self, model, t, state, tau, f_ext, dt):
            return state.v / 2, state.memory

    halved = read(v, dynamics=Halving())
    np.testing.assert_allclose(halved, [0, 0, 0, 1.5 / h + G], rtol=1e-12)


def test_bad_laws() -> None:
    model = rb.load(TOWER)
    state = model.default_state()
    with pytest.raises(rb.InputError, match="sense: contact is 'rigid', expected one of"):
        rb.sense(model, state, contact="rigid")
    with pytest.raises(rb.InputError, match=r"sense: dt is -0\.1, expected a positive step"):
        rb.sense(model, state, contact="impulse", dt=-0.1)
