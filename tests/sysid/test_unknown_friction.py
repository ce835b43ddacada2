"""An unknown on dry friction moves the friction of its joint, at rest and in motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.forces import JointFriction
from rbjax.sysid import Setup, Unknown
from rbjax.sysid.jobs.keys import index_of

MODEL = rb.load("double_pendulum")
A, B = MODEL.joint_names
SPEEDS = np.array([-2.0, -0.3, -0.05, 0.0, 0.05, 0.3, 2.0])  # rad/s, about and far from rest


def friction(setup):
    """tau (speeds, nv) of the elements, with both joints at each speed."""
    model = setup.model
    bare = model.replace(forces=())

    def at(v):
        state = rb.State(jnp.zeros(2), jnp.full(2, v))
        return rb.applied_forces(model, state) - rb.applied_forces(bare, state)

    return np.asarray(jax.vmap(at)(jnp.asarray(SPEEDS)))


def setup_of(dtype=jnp.float64, joints=(A, B), **numbers):
    numbers = {"coulomb": jnp.array([0.2, 0.1]), "smoothing": 0.02} | numbers
    model = MODEL if dtype == jnp.float64 else single()
    return Setup.of(model.with_forces(JointFriction.of(model, list(joints), **numbers)))


def single():
    with jax.enable_x64(False):
        return rb.load("double_pendulum")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("place", [0, 1])
def test_it_moves_with_the_unknown_at_every_speed(dtype, place):
    """Twice the force gives twice the friction, at rest too; the other joint keeps its own."""
    setup = setup_of(dtype)
    dry = Unknown("forces.0.coulomb", place, positive=True)
    p = dry.read(setup)
    moved = dry.write(setup, 2 * p)
    before, after = friction(setup), friction(moved)
    assert np.abs(before[-1]).min() > 0.09
    tolerance = 1e-6 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(after[:, place], 2 * before[:, place], atol=tolerance)
    np.testing.assert_array_equal(after[:, 1 - place], before[:, 1 - place])
    assert moved.model.forces[0].breakaway is None
    assert np.abs(after[:, place] + after[::-1, place]).max() < tolerance  # both directions


def test_a_break_away_force_of_its_own_stays():
    setup = setup_of(breakaway=jnp.array([0.4, 0.3]), stribeck=0.05)
    moved = Unknown("forces.0.coulomb", 0).write(setup, jnp.array([0.25]))
    np.testing.assert_array_equal(moved.model.forces[0].breakaway, [0.4, 0.3])
    v, F, Fs = SPEEDS, 0.25, 0.4
    want = -(F + (Fs - F) * np.exp(-((v / 0.05) ** 2))) * np.tanh(v / 0.02)
    np.testing.assert_allclose(friction(moved)[:, 0], want, atol=1e-12)


def test_a_name_is_the_joint_of_the_element():
    """The element has the joints in another order than the model."""
    setup = setup_of(joints=(B, A))
    for joint, column in ((A, 0), (B, 1)):
        dry = Unknown("forces.0.coulomb", index_of(setup, "forces.0.coulomb", joint))
        after = friction(dry.write(setup, jnp.array([0.7])))
        np.testing.assert_allclose(after[-1, column], -0.7, rtol=1e-6)
        assert after[-1, 1 - column] == friction(setup)[-1, 1 - column]


def test_friction_of_a_file_has_no_break_away_of_its_own():
    loaded = rb.load(
        """<mujoco><worldbody><body><joint name="j" frictionloss="0.3"/>
        <geom size="0.1" contype="0" conaffinity="0"/></body></worldbody></mujoco>""",
        friction=True,
    )
    assert loaded.forces[0].breakaway is None
    with pytest.raises(UnknownName, match=r"forces.0.breakaway.*forces.0.coulomb"):
        Unknown("forces.0.breakaway").read(Setup.of(loaded))


def test_a_break_away_force_that_is_no_array_is_refused():
    fields = dict.fromkeys(("coulomb", "stribeck", "smoothing", "viscous"), jnp.ones(2))
    for bad in ("x", [1.0, 2.0], jnp.array([1.0, jnp.nan])):
        with pytest.raises(InputError, match="breakaway"):
            JointFriction(**fields, breakaway=bad, joints=(A, B))
    with pytest.raises(InputError, match="breakaway has shape"):
        wrong = JointFriction(**fields, breakaway=jnp.ones(3), joints=(A, B))
        rb.applied_forces(MODEL.with_forces(wrong), MODEL.default_state())
