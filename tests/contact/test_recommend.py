"""The recommended law of contact has the requested accuracy; its measures are closed forms."""

import numpy as np
import pytest

import rbjax as rb

GRAVITY, PULL, TIME = 9.81, 3.0, 0.02
#: an impedance, and a friction of 0.8; the pull along the floor is inside of the cone
IMPEDANCE = 0.9
POINT = f"""<mujoco><option gravity="{PULL} 0 -{GRAVITY}" cone="elliptic"/>
<default><geom solref="{TIME} 1" solimp="{IMPEDANCE} {IMPEDANCE} 0.001 0.5 2" friction="0.8"/>
</default><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1">
<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>"""
DEPTH = GRAVITY * (1 - IMPEDANCE) * TIME**2
SPEED = PULL * (1 - IMPEDANCE) * TIME / 2
HORIZON = 0.3


@pytest.fixture(scope="module")
def model():
    return rb.load(POINT)


def recommended(model, accuracy, z=-DEPTH, **how):
    state = rb.State(np.array([0.0, z]), np.zeros(2))
    return rb.recommend.contact_law(model, state, accuracy, horizon=HORIZON, progress=False, **how)


def test_penetration_and_creep_are_closed_forms_and_decide(model):
    loose = recommended(model, 2e-3)
    law = {x.name: x for x in loose.candidates}
    assert list(law) == [*rb.contact.laws(), "compliant"]
    np.testing.assert_allclose(law["mujoco"].penetration, DEPTH, rtol=1e-2)
    np.testing.assert_allclose(law["mujoco"].creep, SPEED * HORIZON, rtol=0.1)
    np.testing.assert_allclose(law["coulomb"].penetration, DEPTH, rtol=1e-2)
    assert law["coulomb"].creep < 0.1 * law["mujoco"].creep
    assert law["impulse"].penetration < DEPTH * 1.01 and law["impulse"].creep < 1e-5
    assert all(x.success for x in loose.candidates)
    assert loose.cost == min(x.cost for x in law.values())
    assert "no contact slips in this motion; cost decides: " in loose.reason

    found = recommended(model, 0.5 * (DEPTH + SPEED * HORIZON))
    assert found.name != "mujoco" and "accuracy decides: mujoco slips 8" in found.reason
    path = rb.rollout(
        found.model, rb.State(np.array([0.0, -DEPTH]), np.zeros(2)), None, found.dt, steps=150,
        contact=found.contact,
    )  # fmt: skip
    assert abs(path.q[-1, 0]) < 0.1 * SPEED * HORIZON
    assert found.table().startswith("name")


def test_a_body_that_is_pushed_out_of_the_floor_gains_energy(model):
    with pytest.raises(rb.InputError, match=r"no law is within .*: mujoco presses in by 2\.0e-02"):
        recommended(model, 2e-3, z=-0.02)
    law = {x.name: x for x in recommended(model, 0.05, z=-0.02).candidates}
    assert 0.015 < law["mujoco"].lift < 0.05


def test_bad_requests(model):
    state = model.default_state()
    with pytest.raises(rb.InputError, match="accuracy is"):
        rb.recommend.contact_law(model, state, 1e-12)
    with pytest.raises(rb.InputError, match="horizon / dt is 0, expected"):
        rb.recommend.contact_law(model, state, horizon=1e-4)
    with pytest.raises(rb.InputError, match="restitution is 2"):
        rb.recommend.contact_law(model, state, restitution=2.0)
    with pytest.raises(rb.InputError, match="geoms"):
        pendulum = rb.load("pendulum")
        rb.recommend.contact_law(pendulum, pendulum.default_state())
