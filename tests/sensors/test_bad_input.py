"""Wrong sensors: one sentence each, for every kind that needs a name, a number or a function."""

import re

import numpy as np
import pytest

import rbjax as rb
from rbjax import sensors
from rbjax.errors import InputError, RbjaxError, UnknownName

ARM = rb.load("arm7")
STATE = ARM.default_state()
GYRO = sensors.NamedSensor("gyro", sensors.Gyro("tool"))
VOLUME = sensors.Volume


def read(sensor):
    return rb.sense(ARM.replace(sensors=(sensors.NamedSensor("x", sensor),)), STATE)


SENTENCES = {
    "function is int, expected a function (context)": lambda: sensors.CustomSensor(3, 1),
    "function takes (), expected a function": lambda: sensors.CustomSensor(lambda: 0, 1),
    "CustomSensor: size is 0": lambda: sensors.CustomSensor(lambda context: 0, 0),
    "'x': the reading has shape (7,), expected (2,)": lambda: read(
        sensors.CustomSensor(lambda context: context.q, 2)
    ),
    "Currents: constant is 'a'": lambda: sensors.Currents("a"),
    "Currents: constant has a 0": lambda: sensors.Currents(np.zeros(7)),
    "Currents: constant has shape (3,)": lambda: read(sensors.Currents(np.ones(3))),
    "the size of the box is (0.1,), expected 3 numbers": lambda: sensors.Touch(
        "tool", VOLUME("box", (0.1,))
    ),
    "the size of the sphere is (-1,)": lambda: sensors.InsideSite("tool", VOLUME("sphere", (-1,))),
    "the size of the volume[0] is nan": lambda: sensors.Touch("tool", VOLUME("sphere", (np.nan,))),
    "cutoff is True": lambda: sensors.NamedSensor("a", sensors.Gyro("tool"), cutoff=True),
    "sensors=...): got Gyro, expected a tuple": lambda: ARM.replace(sensors=sensors.Gyro("tool")),
    "sensors=...): got Gyro in it": lambda: ARM.replace(sensors=(sensors.Gyro("tool"),)),
    "'gyro' is the name of two sensors": lambda: ARM.replace(sensors=(GYRO, GYRO)),
}


@pytest.mark.parametrize("sentence", SENTENCES)
def test_sentence(sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        SENTENCES[sentence]()


PLACED = [name for name, kind in sensors.kinds().items() if kind.placed]


@pytest.mark.parametrize("name", PLACED)
def test_a_place_that_the_robot_does_not_have(name: str) -> None:
    if name in ("touch", "insidesite"):  # their sites have shapes that a model does not keep
        with pytest.raises(InputError, match="volume is None"):
            sensors.sensor_of(f"{name}:nowhere")
        return
    with pytest.raises(RbjaxError, match=r"known .*names:|expected one of") as raised:
        read(sensors.sensor_of(f"{name}:nowhere"))
    assert isinstance(raised.value, UnknownName) or name == "contact"


@pytest.mark.parametrize("name", [n for n, kind in sensors.kinds().items() if not kind.placed])
def test_sensors_of_a_robot_without_joints(name: str) -> None:
    """They read nothing, or zero: never NaN."""
    empty = rb.load("<mujoco/>")
    model = empty.replace(sensors=(sensors.NamedSensor("x", sensors.sensor_of(name)),))
    assert not np.any(rb.sense(model, model.default_state()))
