"""`Model.replace` with a value that is not a part of a model: one sentence each."""

import re

import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.errors import InputError
from rbjax.model.model import OPTIONAL, RECORDS, TUPLES

MODEL = rb.load("cart_pole")


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
