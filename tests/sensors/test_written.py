"""Sensors in files that `write_mjcf` writes, and sensors of the model by name."""

import warnings

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import Attitude, CustomSensor, Gyro, NamedSensor
from rbjax.sysid import Channel, Recording, Setup
from tests.sensors.equipped import loaded, rich

#: geoms are not in a written file
LEFT_OUT = "RANGEFINDER"


def test_written_sensors_read_as_those_of_the_file():
    """MuJoCo's sensordata of the written file, at centers of mass, geoms and cameras too."""
    m = rich()
    model = loaded(m)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = rb.write_mjcf(model)
    assert "read back as others" not in text
    again = mujoco.MjModel.from_xml_string(text)
    assert [again.sensor(i).name for i in range(again.nsensor)] == [
        x.name for x in model.sensors
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    data = [mujoco.MjData(x) for x in (m, again)]
    for x in (m, again):
        x.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        x.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data[0].qvel[:] = rng.normal(size=m.nv)
    mujoco.mj_integratePos(m, data[0].qpos, rng.normal(size=m.nv), 0.2)
    data[1].qpos[:], data[1].qvel[:] = data[0].qpos, data[0].qvel
    for x, d in zip((m, again), data, strict=True):
        mujoco.mj_forward(x, d)
    for i in range(again.nsensor):
        name = again.sensor(i).name
        kind = mujoco.mjtSensor(int(again.sensor_type[i])).name[7:]
        if kind != LEFT_OUT:
            one, other = (d.sensor(name).data for d in data)
            if kind == "FRAMEQUAT":
                other = other * np.sign(one @ other)
            np.testing.assert_allclose(other, one, atol=1e-9, err_msg=f"{kind} {name}")


def test_what_a_file_cannot_have_is_named():
    model = rb.load("two_link")
    height = CustomSensor(lambda context: context.q[:1], 1)
    model = model.replace(sensors=(NamedSensor("height", height), NamedSensor("spin", Gyro("tip"))))
    with pytest.warns(UserWarning, match=r"sensors that are left out \(height\)"):
        text = rb.write_mjcf(model)
    (read,) = rb.load(text).sensors
    assert read.name == "spin" and isinstance(read.sensor, Gyro)


def test_a_frame_of_the_center_of_mass_gets_a_site():
    frame = rb.Frame(center="link2", orientation=(0.5, 0.5, 0.5, 0.5))
    model = rb.load("two_link")
    model = model.replace(sensors=(NamedSensor("turn", Attitude(frame), noise=0.1),))
    (read,) = rb.load(rb.write_mjcf(model, strict=True)).sensors
    assert read.noise == 0.1 and read.sensor.frame.site is not None


def test_sensors_of_the_model_are_in_a_setup_by_name():
    model = rb.load("two_link").replace(sensors=(NamedSensor("imu", Gyro("tip"), cutoff=0.5),))
    setup = Setup.of(model).with_sensors("sensor:imu")
    assert setup.sensors["sensor:imu"].bias.shape == (3,) and setup.unit("sensor:imu") == "rad/s"
    state = model.default_state().replace(v=jnp.ones(2))
    context = rb.sensors.Context.of(model, 0.0, state, None)
    assert abs(setup.sensor("sensor:imu")(context)).max() == 0.5
    Recording("a", {"sensor:imu": Channel([0.0, 1.0], np.zeros((2, 3)))})
    with pytest.raises(rb.UnknownName, match=r"sensor of the model 'nose'.*'imu'"):
        setup.with_sensors("sensor:nose")
