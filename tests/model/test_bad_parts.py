"""`Model.replace` with a value that is not a part of a model: one sentence each."""

import re

import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.model.model import CONTACT_NAMES, OPTIONAL, RECORDS, TUPLES

MODEL = rb.load("cart_pole")
BALL = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1"><freejoint/>
  <geom size="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_of_another_class(name: str) -> None:
    wrong = [3, "a", MODEL, rb.Model, *([] if name in OPTIONAL else [None])]
    for value in wrong:
        sentence = f"Model.replace({name}=...): got"
        with pytest.raises(InputError, match=re.escape(sentence)):
            MODEL.replace(**{name: value})
    MODEL.replace(**{name: getattr(MODEL, name)})


@pytest.mark.parametrize("name", TUPLES)
def test_a_tuple_of_other_objects(name: str) -> None:
    for value in (3, None, "a", (3,), ("a",), (MODEL,), (rb.Model,), jnp.zeros(2)):
        with pytest.raises(InputError, match=re.escape(f"Model.replace({name}=...): got")):
            MODEL.replace(**{name: value})
    assert getattr(MODEL.replace(**{name: []}), name) == ()


def test_a_contact_law_and_bodies_that_do_not_exist() -> None:
    ball = rb.load(BALL)
    for law in ("mojoco", "", 3, ["mujoco"]):
        with pytest.raises(UnknownName, match="contact law"):
            ball.replace(contact=law)
    assert tuple(rb.contact.laws()) == CONTACT_NAMES
    assert all(ball.replace(contact=law).contact == law for law in (*CONTACT_NAMES, None))
    law = rb.contact.SoftContact(iterations=5)
    assert rb.acceleration(ball.replace(contact=law), ball.default_state()).shape == (6,)
    with pytest.raises(InputError, match="geom on body 7, expected the -1 of the world"):
        ball.replace(geoms=ball.geoms.replace(bodies=(-1, 7)))
    for bodies in ((-2, 0), (0.5, 0), ("world", 0), (True, 0)):
        with pytest.raises(InputError, match=r"indices of bodies as .* and -1 for the world"):
            ball.geoms.replace(bodies=bodies)
