"""Sensors that read the forces of the contact solver, against MuJoCo C."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import ContactSensor
from tests.tolerances import F64_PARITY, GRADIENT, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

ALL = "found force torque dist pos normal tangent linvel angvel"
NET = "found force torque dist pos normal tangent"
PARTS = [
    'geom1="floor" geom2="a"', 'geom1="a" geom2="floor"', 'geom1="a"', 'geom2="a"', "",
    'body1="arm" body2="box"', 'subtree1="box"', 'subtree1="base" subtree2="world"', 'site="pad"',
]  # fmt: skip
SCENE = """<mujoco><option timestep=".002" cone="{cone}" tolerance="0" iterations="100"
  ls_tolerance="1e-10"/><worldbody>
<geom name="floor" type="plane" size="0 0 1" condim="4"/>
<body name="box" pos="0 0 .105"><freejoint/><geom name="a" type="box" size=".1 .1 .1" condim="6"/>
  <site name="pad" type="box" size=".12 .02 .3"/></body>
<body name="base" pos="0 .3 .3"><joint name="lift" type="slide" axis="0 0 1" range="-.03 .1"
    limited="true" damping="1"/>
  <geom name="b" type="sphere" size=".03" pos="0 0 .1"/><site name="wrist" pos="0 0 .02"/>
  <body name="arm"><joint name="turn" axis="1 0 0" range="-3 30" limited="true"/>
    <geom name="c" type="capsule" size=".03" fromto="0 0 0 0 -.3 -.06" condim="3"/>
    <site name="tip" type="sphere" size=".06" pos="0 -.3 -.06"/></body></body>
</worldbody><sensor>{sensors}</sensor></mujoco>"""
OTHERS = """<touch site="pad"/><touch site="tip"/><force site="wrist"/><torque site="wrist"/>
<force site="tip"/><torque site="tip"/><accelerometer site="tip"/><accelerometer site="pad"/>
<jointlimitfrc joint="turn"/><jointlimitfrc joint="lift" name="end"/>"""


def compiled(sensors: str, cone: str = "elliptic") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SCENE.format(cone=cone, sensors=sensors))


def moved(m: mujoco.MjModel, steps: int, lift: float = -1.0) -> mujoco.MjData:
    d = mujoco.MjData(m)
    d.qvel[:] = [0.3, 0.1, 0, 0.2, 0.1, 0.5, lift, 0.5]
    for _ in range(steps):
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    return d


def check(m: mujoco.MjModel, *, steps: tuple[int, ...], lift: float = -1.0) -> list[mujoco.MjData]:
    """Compare all sensors after steps from a velocity of the slide joint, and return the data."""
    model, data = rb.load(m, contacts=True), []
    assert not any("sensor" in x for x in model.dropped)
    run = jax.jit(rb.threads(lambda q, v: rb.sense(model, rb.State(q, v))))
    for n in steps:
        data.append(d := moved(m, n, lift))
        found = np.asarray(run(d.qpos, d.qvel))
        for i in range(m.nsensor):
            at = slice(m.sensor_adr[i], m.sensor_adr[i] + m.sensor_dim[i])
            error = relative_error(found[at], d.sensordata[at], floor=1.0)
            assert error < F64_PARITY, (n, m.sensor(i).name, found[at], d.sensordata[at])
    return data


def test_contact_sensors_read_as_mujoco() -> None:
    """All parts and reductions, with as many slots as contacts, more and fewer."""
    slots = (("none", 6), ("mindist", 2), ("maxforce", 1), ("netforce", 2))
    sensors = "".join(
        f'<contact name="{k} {reduce}" {parts} num="{num}" reduce="{reduce}" '
        f'data="{NET if reduce == "netforce" else ALL}"/>'
        for k, parts in enumerate(PARTS)
        for reduce, num in slots
    )
    first, *_ = check(compiled(sensors), steps=(80, 1))
    assert first.ncon >= 5


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_touch_force_and_limit_sensors_read_as_mujoco(cone: str) -> None:
    """Touch, force and torque, accelerometers, and both ends of limits."""
    m = compiled(OTHERS, cone)
    data = check(m, steps=(20, 80, 300)) + check(m, steps=(30, 80), lift=3.0)
    sums = np.abs([d.sensordata for d in data]).sum(0)
    assert (np.maximum.reduceat(sums, m.sensor_adr) > 1e-3).all()
    ends = [d.joint("lift").qpos[0] > 0 for d in data if d.sensor("end").data[0] > 1e-3]
    assert any(ends) and not all(ends)


#: a bar on the floor that a connect and a weld hold, and a lever with a tendon at its limit
HELD = """<mujoco><option timestep=".002" tolerance="0" iterations="100" ls_tolerance="1e-10"/>
<worldbody><geom type="plane" size="0 0 1"/>
<body name="lever" pos="0 0 .2"><joint name="p" axis="0 1 0"/><joint name="s" type="slide"
    axis="1 0 0"/><geom type="sphere" size=".05" pos=".1 0 0"/><site name="in" pos=".02 0 0"/>
  <body name="tip" pos=".2 0 0"><joint name="b" type="ball"/>
    <geom type="sphere" size=".03" pos=".05 0 0"/><site name="out" pos=".01 0 0"/></body></body>
<body name="bar" pos=".3 0 .0495"><freejoint/><geom type="box" size=".1 .05 .05"/>
  <site name="bar"/></body>
<body name="cap" pos=".3 0 .12"><freejoint/><geom type="box" size=".02 .02 .02"/>
  <site name="cap"/></body>
</worldbody><equality><connect body1="tip" body2="bar" anchor=".05 0 0"/>
<weld body1="cap" body2="bar"/></equality>
<tendon><fixed name="t" limited="true" range="-.02 .02"><joint joint="p" coef="1"/><joint joint="s"
  coef="-2"/></fixed></tendon><sensor>{sensors}</sensor></mujoco>"""


def test_forces_of_equalities_and_tendon_limits_with_contacts() -> None:
    sensors = "".join(
        f'<force site="{s}"/><torque site="{s}"/><accelerometer site="{s}"/>'
        for s in ("in", "out", "bar", "cap")
    )
    m = mujoco.MjModel.from_xml_string(
        HELD.format(sensors=sensors + '<tendonlimitfrc tendon="t"/>')
    )
    model, d = rb.load(m, contacts=True), mujoco.MjData(m)
    run, most = jax.jit(rb.threads(lambda q, v: rb.sense(model, rb.State(q, v)))), 0.0
    for _ in range(4):
        for _ in range(15):
            mujoco.mj_step(m, d)
        mujoco.mj_forward(m, d)
        assert d.ncon and d.ne == 9
        assert relative_error(run(d.qpos, d.qvel), d.sensordata, floor=1.0) < F64_PARITY
        most = max(most, d.sensordata[-1])
    assert most > 0.1


def test_a_contact_in_the_gap_is_found() -> None:
    """It has no force. A batch, f32, and a sensor of a model without contacts."""
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1" margin=".1" gap=".1"/>
    <body name="ball" pos="0 0 .25"><freejoint/><geom type="sphere" size=".1"/></body></worldbody>
    <sensor><contact geom1="floor" data="found force dist" num="2"/>
    <contact subtree2="ball" data="found pos normal" reduce="netforce"/></sensor></mujoco>"""
    m = mujoco.MjModel.from_xml_string(text)
    model = rb.load(m, contacts=True)
    heights = jnp.array([0.25, 0.5, 0.19])

    def read(model, z):
        state = model.default_state()
        return rb.sense(model, state.replace(q=state.q.at[2].set(z)))

    found = jax.jit(jax.vmap(lambda z: read(model, z)))(heights)
    d = mujoco.MjData(m)
    for z, row in zip(heights, found, strict=True):
        d.qpos[2] = z
        mujoco.mj_forward(m, d)
        assert relative_error(row, d.sensordata, floor=1.0) < F64_PARITY
    assert found[0, 0] == 1 and found[1, 0] == 0 and found[2, 1] > 1
    single = model.astype(jnp.float32)
    short = jax.jit(lambda z: read(single, z))(jnp.float32(0.19))
    assert short.dtype == jnp.float32 and relative_error(short, found[2]) < 1e-3
    free = model.replace(contact=None)
    assert not np.any(read(free, 0.19))


def test_derivative_of_a_sum_of_forces() -> None:
    m = compiled('<contact geom1="floor" data="force torque" reduce="netforce"/>')
    model, d = rb.load(m, contacts=True), moved(m, 80)

    def f(v):
        return rb.sense(model, rb.State(jnp.asarray(d.qpos), v))

    f, v = jax.jit(f), jnp.asarray(d.qvel)
    J, h = jax.jacrev(f)(v), 1e-6
    rows = [(f(v + h * e) - f(v - h * e)) / (2 * h) for e in jnp.eye(len(v))]
    assert relative_error(J, jnp.stack(rows, 1), floor=1.0) < 10 * GRADIENT


def test_written_contact_sensors() -> None:
    sensors = '<contact geom1="floor" body2="box" data="found force" num="3" reduce="mindist"/>'
    sensors += '<contact site="pad" subtree2="base" data="dist"/><contact data="found"/>'
    model = rb.load(compiled(sensors), contacts=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = rb.load(rb.write_mjcf(model), contacts=True)
    assert [x.sensor for x in again.sensors] == [x.sensor for x in model.sensors]


def test_bad_contact_sensors() -> None:
    model = rb.load(compiled(""), contacts=True)
    with pytest.raises(rb.UnknownName, match="reduction of a contact sensor"):
        ContactSensor("geom:floor", reduce="sum")
    with pytest.raises(rb.UnknownName, match="data of a contact sensor"):
        ContactSensor("geom:floor", data=("depth",))
    with pytest.raises(rb.InputError, match="expected a tuple of some of"):
        ContactSensor("geom:floor", data="found")
    with pytest.raises(rb.InputError, match="reduce='netforce' has no velocities"):
        ContactSensor("geom:floor", data=("linvel",), reduce="netforce")
    with pytest.raises(rb.InputError, match="num is 0"):
        ContactSensor("geom:floor", num=0)
    for part, message in (("floor", "a part is 'floor', expected one of"), ("geom:no", "geom")):
        with pytest.raises(rb.RbjaxError, match=message):
            ContactSensor(part).columns(model)
    with pytest.raises(rb.InputError, match="second is a site"):
        ContactSensor("geom:floor", "site:pad").columns(model)
    assert ContactSensor("geom:floor", data=("found", "dist")).unit(model) == "1 or m"
