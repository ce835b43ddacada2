"""Checks of single arguments: what passes, and what is said of the rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.arguments import instance, integer, real_array, real_number, shown

REAL = [1, 2.5, np.float32(3), np.array(4), jnp.array(5.0), jnp.float32(6)]
NOT_REAL = [None, "1", True, 1j, [1.0], np.ones(2), np.nan, np.inf, 10**400, {}, len, object(),
            jnp.array(np.nan), np.array("a")]  # fmt: skip


@pytest.mark.parametrize("x", REAL)
def test_numbers_pass(x):
    real_number("f", "x", x, "a number", above=0.0, least=1.0)


@pytest.mark.parametrize("x", [*NOT_REAL, 0, -1.0], ids=range(len(NOT_REAL) + 2))
def test_others_are_rejected(x):
    with pytest.raises(
        rb.InputError, match=r"f: x (is|has shape) .*, expected a number above zero"
    ):
        real_number("f", "x", x, "a number above zero", above=0.0)


def test_bounds_and_traced_values():
    real_number("f", "x", 0.0, "at least 0", least=0.0)
    with pytest.raises(rb.InputError, match=r"f: x is -0.1, expected at least 0"):
        real_number("f", "x", -0.1, "at least 0", least=0.0)

    def traced(x):
        real_number("f", "x", x, "a number", above=0.0, traced=True)
        return x

    assert jax.jit(traced)(-1.0) == -1.0
    with pytest.raises(rb.InputError, match="expected a number"):
        jax.jit(traced)(jnp.ones(2))


def test_integers():
    integer("f", "n", 1)
    assert integer("f", "n", np.int32(0), least=0) == 0
    for bad in (0, -1, 1.0, True, "1", None, [1]):
        with pytest.raises(rb.InputError, match=r"f: n is .*, expected an integer of at least 1"):
            integer("f", "n", bad, least=1)
    with pytest.raises(rb.InputError, match="expected an integer of at least 2"):
        integer("f", "n", 1, least=2)


def test_kinds_and_arrays():
    instance("f", "model", rb.load("pendulum"), rb.Model, "rbjax.Model")
    with pytest.raises(rb.InputError, match=r"f: model is 'a', expected rbjax.Model"):
        instance("f", "model", "a", rb.Model, "rbjax.Model")
    assert real_array("f", "x", [1, 2], "numbers").dtype == float
    assert real_array("f", "z", [1, 2j], "numbers", complex_numbers=True).dtype == complex
    assert np.isnan(real_array("f", "x", [np.nan], "numbers", finite=False)).all()
    for bad in (None, "a", [[1.0], [1.0, 2.0]], {}, [np.nan], [1j], [None], len):
        with pytest.raises(rb.InputError, match=r"f: x.* is .*, expected numbers"):
            real_array("f", "x", bad, "numbers")


def test_unknown_names_of_two_kinds_are_listed_apart():
    many = [f"body_{k}" for k in range(50)]
    text = str(rb.UnknownName("body or site", "imo", apart={"body": many, "site": ["imu"]}))
    assert "known body names: " in text and "known site names: 'imu'" in text
    assert "and 30 more" in text and "did you mean 'imu'?" in text
    text = str(rb.UnknownName("joint", "a", []))
    assert text == "unknown joint 'a'; known names: (there are none)"


def test_what_is_shown():
    assert shown("a") == "'a'" and shown([1]) == "[1]"
    assert shown(np.ones(100)).startswith("ndarray array([1., 1.") and shown(len) == (
        "of type builtin_function_or_method"
    )
