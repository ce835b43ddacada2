"""An arm of two links and a robot in flight, and what MuJoCo's sensors show of their motions."""

from __future__ import annotations

import functools
import warnings

import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Recording

T = 0.005

ARM = """
<mujoco><option timestep="0.005" integrator="RK4"/><worldbody>
 <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.001"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.05"/>
   <inertial pos="0.03 0 -0.15" mass="0.6" diaginertia="0.005 0.005 0.001"/>
   <site name="imu" pos="0.02 0.01 -0.25" quat="0.9 0.1 0.3 -0.2"/>
  </body></body></worldbody>
 <actuator><position joint="shoulder" kp="8" gear="2"/><position joint="elbow" kp="5"/></actuator>
 <sensor>
  <accelerometer name="accelerometer:imu" site="imu"/><gyro name="gyro:imu" site="imu"/>
  <framepos name="position:imu" objtype="site" objname="imu"/>
  <framepos name="p" objtype="xbody" objname="lower"/>
  <framequat name="R" objtype="xbody" objname="lower"/>
  <framepos name="ps" objtype="site" objname="imu"/>
  <framequat name="Rs" objtype="site" objname="imu"/>
  <jointactuatorfrc name="tau0" joint="shoulder"/><jointactuatorfrc name="tau1" joint="elbow"/>
 </sensor></mujoco>
"""
FLIGHT = """
<mujoco><option timestep="0.005"/><worldbody>
 <body name="base" pos="0 0 2"><freejoint name="free"/>
  <inertial pos="0 0 0" mass="2" diaginertia="0.02 0.05 0.03"/>
  <site name="imu" pos="0.05 0.1 -0.02" quat="0.8 0.1 -0.4 0.2"/>
 </body></worldbody>
 <sensor>
  <accelerometer name="accelerometer:imu" site="imu"/><gyro name="gyro:imu" site="imu"/>
  <framepos name="position:imu" objtype="site" objname="imu"/>
  <framepos name="p" objtype="xbody" objname="base"/>
  <framequat name="R" objtype="xbody" objname="base"/>
  <framepos name="ps" objtype="site" objname="imu"/>
  <framequat name="Rs" objtype="site" objname="imu"/>
 </sensor></mujoco>
"""
#: which of MuJoCo's sensors make a reading
MADE_OF = {"pose:imu": ("ps", "Rs"), "tau": ("tau0", "tau1")}


@functools.cache
def loaded(xml: str) -> tuple[rb.Model, mujoco.MjModel]:
    with warnings.catch_warnings(action="ignore"):
        return rb.load(xml), mujoco.MjModel.from_xml_string(xml)


def by_mujoco(m: mujoco.MjModel, d: mujoco.MjData, sensor: str) -> np.ndarray:
    """What MuJoCo reads; `sensor` as rbjax calls it."""
    body = ("p", "R") if sensor.startswith("pose:") else (sensor,)
    return np.concatenate([d.sensor(name).data for name in MADE_OF.get(sensor, body)])


@functools.cache
def swung(sensors: tuple[str, ...], rates: tuple[int, ...] = (1,), N: int = 160) -> Recording:
    """The arm as MuJoCo moves it (RK4), each sensor at its own rate, and the start."""
    _, m = loaded(ARM)
    d = mujoco.MjData(m)
    start = (np.array([0.3, -0.4]), np.array([0.5, -1.0]))
    d.qpos[:], d.qvel[:] = start
    t = np.arange(N + 1) * T
    ctrl = np.stack([np.sin(5 * t), 0.8 * np.cos(7 * t)], 1)
    read: dict[str, list] = {sensor: [] for sensor in sensors}
    for u in ctrl:
        d.ctrl[:] = u
        mujoco.mj_forward(m, d)
        for sensor in sensors:
            read[sensor].append(by_mujoco(m, d, sensor))
        mujoco.mj_step(m, d)
    every = dict(zip(sensors, rates * len(sensors), strict=False))
    channels = {s: Channel(t[:: every[s]], np.array(read[s])[:: every[s]]) for s in sensors}
    return Recording("swung", channels | first(t, *start) | {"ctrl": Channel(t, ctrl)})


@functools.cache
def thrown(sensor: str, N: int = 120) -> Recording:
    """The robot in flight as rbjax moves it, in small steps, and what MuJoCo reads there: steps of
    MuJoCo turn attitudes to lower order. The sensor "q" is the motion itself."""
    model, m = loaded(FLIGHT)
    d = mujoco.MjData(m)
    t = np.arange(N + 1) * T
    start = rb.State(model.default_state().q, jnp.array([0.3, -0.2, 1.0, 2.0, 4.0, -3.0]))
    path = rb.rollout(model, start, None, T, steps=N, integrator="rk4", kernel=False)
    if sensor == "q":
        flip = np.where(np.arange(N + 1) % 2, -1.0, 1.0)[:, None]  # both are the same attitude
        q = np.hstack([path.q[:, :3], path.q[:, 3:] * flip])
        return Recording("thrown", first(t, start.q, start.v) | {"q": Channel(t, q)})
    read = []
    for q, v in zip(np.asarray(path.q), np.asarray(path.v), strict=True):
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_forward(m, d)
        read.append(by_mujoco(m, d, sensor))
    return Recording("thrown", first(t, start.q, start.v) | {sensor: Channel(t, np.array(read))})


def first(t: np.ndarray, q: np.ndarray, v: np.ndarray, noise: float | None = None) -> dict:
    """Channels of q and v of which nothing but the first sample arrived."""
    made = {}
    for sensor, x in (("q", q), ("v", v)):
        values = np.full((len(t), len(x)), np.nan)
        values[0] = x
        sigma = None if noise is None else np.full(len(x), noise)
        made[sensor] = Channel(t, values, dropped="nan", noise=sigma)
    return made
