"""Wrong arguments of contact laws and geoms: one sentence each; robots without geoms or joints."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import contact
from rbjax.errors import InputError, RbjaxError

BALL = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.0999"><freejoint/>
  <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""
MODEL = rb.load(BALL, contacts=True)
STATE, GEOMS = MODEL.default_state(), MODEL.geoms


def impulse(**given):
    return contact.impulse(MODEL, STATE, **given)


def moreau(**given):
    return contact.MoreauContact.of(MODEL, **given)


def geoms(**given):
    return GEOMS.replace(**given)


LAWS = {
    "iterations is 0, expected an integer from 1": lambda: contact.SoftContact(iterations=0),
    "iterations is nan": lambda: contact.SoftContact(iterations=np.nan),
    "iterations is 2147483648": lambda: contact.CoulombContact(iterations=2**31),
    "SoftContact: dt is -0.01, expected a number above zero": lambda: contact.SoftContact(dt=-0.01),
    "SoftContact: dt is 'fast'": lambda: contact.SoftContact(dt="fast"),
    "dt is True, expected a positive step": lambda: contact.solve(MODEL, STATE, dt=True),
    "impulse: t is nan": lambda: impulse(t=np.nan),
    "impulse: t is str": lambda: impulse(t="now"),
    "impulse: t has shape (2,)": lambda: impulse(t=[0.0, 1.0]),
    "impulse: restitution is 2.0, expected numbers from 0 to 1": lambda: impulse(restitution=2.0),
    "restitution is nan": lambda: moreau(restitution=np.nan),
    "restitution is 1.5": lambda: rb.simulate_impacts(
        MODEL, STATE, jnp.array([0.0, 1.0]), restitution=1.5
    ),
    "friction is -1.0, expected numbers not below zero": lambda: moreau(friction=-1.0),
    "q[3:7] is a zero quaternion": lambda: contact.detect(MODEL, 0 * STATE.q),
}
REPLACED = {
    "friction=...): got -1.0": lambda: geoms(friction=-GEOMS.friction),
    "condim=...): got (7, 7), expected 1, 3, 4 or 6": lambda: geoms(condim=(7, 7)),
    "priority=...): got (0,), expected a tuple of 2": lambda: geoms(priority=(0,)),
    "names=...): got ['a', 'b'], expected a tuple": lambda: geoms(names=["a", "b"]),
    "pairs=...): got (0, 5), expected the indices": lambda: geoms(pairs=((0, 5),)),
    "pairs=...): got (1, 1), expected the indices": lambda: geoms(pairs=((1, 1),)),
    "pair_condim=...): got (3,), expected a tuple of 0": lambda: geoms(pair_condim=(3,)),
    "geoms=...): got int, expected Geoms or None": lambda: MODEL.replace(geoms=3),
    "solver=...): got str, expected SolverParameters": lambda: MODEL.replace(solver="newton"),
}


@pytest.mark.parametrize("sentence", [*LAWS, *REPLACED])
def test_sentence(sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        (LAWS | REPLACED)[sentence]()


def test_a_robot_without_contacts() -> None:
    """The laws that have the parameters of the file work without geoms that touch."""
    model = rb.load("pendulum")
    state = model.default_state().replace(q=[0.3])
    for law in ("mujoco", "coulomb"):
        found = contact.solve(model, state, contact=law)
        assert found.success and found.contacts.force.shape == (0, 6)
        np.testing.assert_allclose(found.acceleration, rb.acceleration(model, state), rtol=1e-9)


def test_a_robot_without_joints() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = rb.load("<mujoco/>", contacts=True)
    for law in contact.laws():
        with pytest.raises(InputError, match=r"no joints, so nothing moves|no two geoms"):
            contact.solve(model, model.default_state(), contact=law)
    assert rb.kinetic_energy(model, jnp.zeros(0), jnp.zeros(0)) == 0
    with pytest.raises(InputError, match="no bodies"):
        rb.center_of_mass(model, jnp.zeros(0))


HANGING = rb.load(
    """<mujoco><worldbody><body><joint name="a" range="-1 1" axis="0 1 0" limited="true"/>
    <geom size="0.1" pos="0.3 0 0"/><body pos="0.5 0 0"><joint name="b" axis="0 1 0"/>
    <geom size="0.1" pos="0.3 0 0"/></body></body></worldbody>
    <tendon><fixed name="t" range="-1 1" limited="true"><joint joint="a" coef="1"/></fixed>
    <fixed name="s"><joint joint="b" coef="1"/></fixed></tendon></mujoco>"""
)
SOLVER, TENDONS, JOINTS = HANGING.solver, HANGING.tendons, HANGING.joints
BOTH = [[-1.0, 1.0], [-1.0, 1.0]]
PARAMETERS = {
    "unknown cone 'round'": lambda: SOLVER.replace(cone="round"),
    "impratio=...): got -1.0, expected numbers above 0": lambda: SOLVER.replace(impratio=-1.0),
    "impratio=...): got 0.0": lambda: SOLVER.replace(impratio=0.0),
    "frictionloss=...): got -1.0": lambda: SOLVER.replace(frictionloss=[0.0, -1.0]),
    "limited=...): got (9,), expected a tuple of indices": lambda: SOLVER.replace(limited=(9,)),
    "rubbing=...): got (-1,)": lambda: SOLVER.replace(rubbing=(-1,)),
    "Joints.replace(range=...): got [1.0, -1.0] at [1]": lambda: JOINTS.replace(
        range=[[-1.0, 1.0], [1.0, -1.0]]
    ),
    "tendons [1] are not in limited=(0,)": lambda: TENDONS.replace(range=BOTH),
    "tendons [0] are not in rubbing=()": lambda: TENDONS.replace(frictionloss=[1.0, 0.0]),
    "tendons [1] are not in inertial=()": lambda: TENDONS.replace(armature=[0.0, 1.0]),
    "Tendons.replace(frictionloss=...): got -1.0": lambda: TENDONS.replace(
        frictionloss=[-1.0, 0.0], rubbing=(0,)
    ),
    "Tendons.replace(range=...): got [1.0, -1.0] at [0]": lambda: TENDONS.replace(
        range=[[1.0, -1.0], [-np.inf, np.inf]]
    ),
    "Tendons.replace(limited=...): got (2,)": lambda: TENDONS.replace(limited=(2,)),
    "replace pairs=, too": lambda: GEOMS.replace(contype=(0, 0)),
    "the size of the box": lambda: GEOMS.replace(types=("plane", "box")),
    "CompliantContact is a force element": lambda: rb.acceleration(
        MODEL,
        STATE,
        contact=contact.CompliantContact.of(MODEL.replace(contact=None), stiffness=1e4),
    ),
}


@pytest.mark.parametrize("sentence", PARAMETERS)
def test_parameters_of_the_solver(sentence: str) -> None:
    with pytest.raises(RbjaxError, match=re.escape(sentence)):
        PARAMETERS[sentence]()


def test_changed_tendons_act() -> None:
    """A limit that the file does not have acts if it is in `limited`, too."""
    assert TENDONS is not None
    state = rb.State(jnp.array([0.0, 0.5]), jnp.zeros(2))
    limits = TENDONS.replace(range=[[-1.0, 1.0], [-0.1, 0.1]], limited=(0, 1))
    free, held = (rb.acceleration(m, state) for m in (HANGING, HANGING.replace(tendons=limits)))
    assert held[1] < free[1] - 1


@pytest.mark.parametrize("law", ["mujoco", "coulomb", "impulse"])
def test_numbers_that_are_not_finite_stay(law: str) -> None:
    """A force that is NaN gives a motion that is NaN and no success, also without a contact."""
    model = rb.load(BALL.replace("0.0999", "1"))
    wind = lambda t, state: jnp.full(6, jnp.nan) * state.v  # noqa: E731
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = rb.rollout(model, model.default_state(), tau=wind, steps=3, dt=0.002, contact=law)
    assert not path.success and path.unconverged == 3 and np.isnan(path.v[-1]).all()
    v = jax.jit(lambda tau: rb.step(model, model.default_state(), tau=tau, contact=law).v)
    assert np.isnan(v(jnp.full(6, jnp.nan))).all() and np.isfinite(v(jnp.zeros(6))).all()
