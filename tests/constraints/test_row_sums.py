"""Sums and products of rows by their numbers, without a model: values, rates, gradients and
accelerations by the product rule, and rows that are only a rate."""

import math

import pytest

import rbjax as rb
from rbjax.constraints import Row
from rbjax.constraints.rows.row import angle
from rbjax.forces import Loads

A = Row(2.0, 3.0, Loads({0: 5.0}), 7.0)
B = Row(11.0, 13.0, Loads({0: 17.0, 1: 19.0}), 23.0)
RATE = Row(None, 3.0, Loads({0: 5.0}), 7.0)


def numbers(row):
    tau = {k: float(x) for k, x in row.gradient.tau.items()}
    value = None if row.value is None else float(row.value)
    return value, float(row.rate), tau, float(row.acceleration)


def test_sums():
    assert numbers(A + B) == (13.0, 16.0, {0: 22.0, 1: 19.0}, 30.0)
    assert numbers(A - B) == (-9.0, -10.0, {0: -12.0, 1: -19.0}, -16.0)
    assert numbers(A + 4.0) == (6.0, 3.0, {0: 5.0}, 7.0)
    assert numbers(4.0 - A) == (2.0, -3.0, {0: -5.0}, -7.0)
    assert numbers(-A) == (-2.0, -3.0, {0: -5.0}, -7.0)


def test_products():
    assert numbers(A * 4.0) == (8.0, 12.0, {0: 20.0}, 28.0)
    found = numbers(A * B)
    assert found[:3] == (22.0, 2 * 13.0 + 11 * 3.0, {0: 2 * 17.0 + 11 * 5.0, 1: 2 * 19.0})
    assert found[3] == 2 * 23.0 + 11 * 7.0 + 2 * 3.0 * 13.0  # a b'' + a'' b + 2 a' b'


def test_a_function_of_a_row():
    value, rate, tau, acceleration = numbers(A.apply(lambda x: x**3))
    assert (value, rate, tau) == (8.0, 12 * 3.0, {0: 60.0})
    assert acceleration == 12 * 7.0 + 12 * 3.0**2  # f' g'' + f'' g'^2


def test_rows_of_a_rate():
    assert numbers(RATE - 0.5) == (None, 2.5, {0: 5.0}, 7.0)
    assert numbers(RATE + RATE) == (None, 6.0, {0: 10.0}, 14.0)
    assert numbers(RATE * 2.0) == (None, 6.0, {0: 10.0}, 14.0)
    value, rate, tau, acceleration = numbers(RATE * A)  # g y' + g' y
    assert (value, rate, tau) == (None, 6.0, {0: 10.0}) and acceleration == 2 * 7.0 + 3.0 * 3.0
    for found in (RATE + A, A + RATE):  # a value is added to the rate
        assert numbers(found) == (None, 5.0, {0: 5.0}, 10.0)
    assert numbers(A.time_derivative) == (None, 3.0, {0: 5.0}, 7.0)
    with pytest.raises(rb.InputError, match="two rows that have only a rate"):
        RATE * RATE
    with pytest.raises(rb.InputError, match="only a rate"):
        _ = RATE.time_derivative


def test_an_angle_of_its_sine_and_cosine():
    """Of an angle 2 t at t = 0.4: its rate is 2, and it does not accelerate."""
    turned = 0.8
    s, c = math.sin(turned), math.cos(turned)
    sine = Row(s, 2 * c, Loads({0: c}), -4 * s)
    cosine = Row(c, -2 * s, Loads({0: -s}), -4 * c)
    found = numbers(angle(sine, cosine))
    assert found[0] == pytest.approx(turned) and found[1] == pytest.approx(2.0)
    assert found[2][0] == pytest.approx(1.0) and found[3] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(rb.InputError):
        angle(sine.time_derivative, cosine)
