"""What verdicts and refusals say."""

import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid

RNG = np.random.default_rng(0)


def test_the_sentence_of_a_model_that_holds():
    noise = RNG.normal(size=(3, 200))
    y = 100 * np.sin(0.1 * np.arange(200))
    says = sysid.statistics.held_out({"a": noise[0]}, {"b": noise[1]}, measured={"b": y}, noise=1.0)
    rms = np.sqrt((noise[1] ** 2).mean())
    assert says.success and says.failed == () and "failed" not in says.summary()
    assert f"; the error is {rms:.3g} times the noise" in says.summary()
    assert says.summary().startswith("the model holds")
    says = sysid.statistics.held_out({"a": noise[0]}, {"b": 4 * noise[1]}, noise=1.0)
    assert says.summary().startswith("the model fails") and says.failed
    assert says.summary().endswith("failed: " + "; ".join(says.failed))


def test_a_refusal_begins_with_the_function_and_the_argument():
    J = np.ones((4, 1))
    swing = sysid.Recording("swing", {"q": sysid.Channel(0.1 * np.arange(9), np.zeros(9))})
    rotor = {"rotor": sysid.Unknown("joints.armature", 0)}
    calls = {
        "estimates: residual": lambda: sysid.statistics.estimates(
            ["a"], [1.0], J, residual=[[1.0], [2.0]]
        ),
        "many_starts: spread": lambda: sysid.many_starts(
            rb.load("pendulum"), swing, rotor, spread="wide"
        ),
        "monte_carlo: found": lambda: sysid.monte_carlo(3.0),
        "stanley: speed": lambda: rb.wheeled.stanley(
            [[0.0] * 3, [1.0] * 3], [0.0] * 3, speed="fast", wheelbase=1.0
        ),
    }
    for says, call in calls.items():
        with pytest.raises(rb.InputError, match=f"^{says}"):
            call()
