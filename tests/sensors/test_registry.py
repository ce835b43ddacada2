"""A sensor is added by one class: it is simulated, recorded and calibrated by its name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sensors
from rbjax.sensors.fixed import FrameSensor
from rbjax.sensors.geometry.volumes import VolumeSensor
from rbjax.sensors.protocol import _KINDS
from rbjax.sysid import Channel, Recording, Setup, Unknown, identify
from tests.robots import robot
from tests.tolerances import F64_ROUNDING


@pytest.fixture
def compass():
    """A sensor of one axis of a site, as a user adds it."""

    @sensors.register("compass", placed=True)
    class Compass(FrameSensor):
        def __call__(self, context):
            return self.at(context).rotation.T.columns[0].array

        def unit(self, model):
            return "1"

    yield Compass
    del _KINDS["compass"]


def test_a_sensor_is_added_by_one_class(compass):
    model = rb.load("arm7")
    setup = Setup.of(model).with_sensors("compass:tool")
    state = model.random_state(jax.random.key(0))
    context = sensors.Context.of(model, 0.0, state, jnp.zeros(model.nu))
    R = rb.frame_pose(model, state.q, site="tool")[0]
    found = setup.sensor("compass:tool")(context)
    np.testing.assert_allclose(found, R.T[:, 0], atol=F64_ROUNDING)
    assert setup.sensors["compass:tool"].bias.shape == (3,)
    assert Recording("a", {"compass:tool": Channel([0.0, 1.0], np.zeros((2, 3)))}).channels


def test_a_registered_sensor_is_fitted():
    """The bias of a sensor that a user adds."""

    @sensors.register("cosine")
    class Cosine(sensors.CustomSensor):
        def __init__(self):
            super().__init__(lambda context: jnp.cos(context.state.q), 1)

    try:
        model, t = rb.load("pendulum"), np.arange(41) * 0.02
        seen = rb.rollout(model, rb.State(jnp.array([0.5]), jnp.zeros(1)), np.zeros((40, 1)), 0.02)
        q = np.asarray(seen.q)
        channels = {"q": Channel(t, q), "cosine": Channel(t, np.cos(q) + 0.25)}
        setup = Setup.of(model).with_sensors("cosine")
        found = identify(
            setup, Recording("swing", channels), {"bias": Unknown("sensors.cosine.bias", 0)},
            restarts=0,
        )  # fmt: skip
        assert abs(found.values["bias"] - 0.25) < 0.01
    finally:
        del _KINDS["cosine"]


BELT = """<mujoco><worldbody><body><joint name="j"/><geom size="0.1" contype="0" conaffinity="0"/>
</body></worldbody><tendon><fixed name="belt"><joint joint="j" coef="2"/></fixed></tendon>
</mujoco>"""


@pytest.mark.parametrize("name", [*sensors.kinds()])
def test_names_are_as_many_as_values(name):
    imu = sensors.NamedSensor("imu", sensors.Gyro("tip"))
    own = rb.load(BELT) if name.startswith("tendon") else robot("small").model
    model, kind = own.replace(sensors=(imu,)), sensors.kinds()[name]
    places = {
        "frame": "tip",
        "joint": "ball" if name.startswith("ball") else "hinge",
        "actuator": "servo",
        "body": "hand",
        "name": "imu",
        "tendon": "belt",
        "first": "body:hand",
    }
    place = f":{places[dataclasses.fields(kind.sensor)[0].name]}" if kind.placed else ""
    if issubclass(kind.sensor, VolumeSensor):  # a name does not say its volume
        with pytest.raises(rb.InputError, match="volume is None, expected a rbjax"):
            sensors.sensor_of(name + place)
        sensor = kind.sensor("tip", volume=sensors.Volume("sphere", (0.1,)))
    else:
        sensor = sensors.sensor_of(name + place)
    assert len(sensor.names(model)) == sensor.columns(model).size
    assert isinstance(sensor, sensors.Sensor) and sensor.unit(model)
    state = model.random_state(jax.random.key(0))
    context = sensors.Context.of(model, jnp.array(0.0), state, jnp.zeros(model.nu))
    assert sensor(context).shape == (sensor.columns(model).size,)


def test_wrong_names_are_errors():
    for name in ("gyro", "q:tool", "nope", "nope:tool", 5):
        with pytest.raises(rb.UnknownName, match="sensor kind"):
            sensors.sensor_of(name)
    for name in (5, "a b", "gyro:x"):
        with pytest.raises(rb.InputError, match="register: name is"):
            sensors.register(name)
    with pytest.raises(rb.InputError, match="placed is 5"):
        sensors.register("x", placed=5)
    with pytest.raises(rb.InputError, match="gyro is the name of Gyro"):
        sensors.register("gyro")(int)
