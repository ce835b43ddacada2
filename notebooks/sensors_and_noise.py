# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An IMU instead of encoders, and a wind that nobody measured
#
# Two questions that come before any fit. Which sensor shows which number? And is the error that
# remains noise of the sensors, or is the robot pushed by something that is not in the model? Both
# parts use data whose truth is known: MuJoCo simulates an arm with an IMU, rbjax a pendulum in
# gusts.

# %%
import warnings

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import rbjax as rb
from rbjax import sysid
from rbjax.plotting import INK, PALETTE, STYLE
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE | {"figure.dpi": 95})
BLUE, ORANGE, GREEN, *_ = PALETTE

# %% [markdown]
# ## An arm with an IMU
#
# Two links swing for a second under known torques. The joints have encoders at 50 Hz with a noise
# of 2 mrad. On the lower link sits an IMU: a gyro at 200 Hz with a bias, and an accelerometer at
# 100 Hz. Sought are the mass and the centre of mass of the lower link, the friction of both joints,
# and the bias.

# %%
T, N = 0.005, 200
ARM = """
<mujoco><option timestep="0.005" integrator="RK4"/><worldbody>
 <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.001"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.05"/>
   <inertial pos="0.03 0 -0.15" mass="0.6" diaginertia="0.005 0.005 0.001"/>
   <site name="imu" pos="0.02 0.01 -0.25"/>
  </body></body></worldbody>
 <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
 <sensor><gyro site="imu"/><accelerometer site="imu"/></sensor></mujoco>
"""
GYRO_BIAS = np.array([0.01, -0.02, 0.015])
NOISE = {"q": 2e-3, "gyro:imu": 5e-3, "accelerometer:imu": 0.05}

m = mujoco.MjModel.from_xml_string(ARM)
d = mujoco.MjData(m)
d.qpos[:], d.qvel[:] = (0.3, -0.4), (0.0, 0.0)
t = np.arange(N + 1) * T
torques = np.stack([1.2 * np.sin(9 * t), 0.5 * np.cos(12 * t)], 1)
rows = {name: [] for name in NOISE}
for u in torques:
    d.ctrl[:] = u
    mujoco.mj_forward(m, d)
    read = (d.qpos, d.sensordata[:3] + GYRO_BIAS, d.sensordata[3:])
    for name, x in zip(NOISE, read, strict=True):
        rows[name].append(x.copy())
    mujoco.mj_step(m, d)

rng = np.random.default_rng(0)
every = {"q": 4, "gyro:imu": 1, "accelerometer:imu": 2}
channels = {"ctrl": Channel(t[:-1], torques[:-1])}
for name, noise in NOISE.items():
    x = np.array(rows[name]) + noise * rng.normal(size=np.shape(rows[name]))
    x[0] = rows[name][0]  # the start is known
    channels[name] = Channel(t[:: every[name]], x[:: every[name]], noise=np.full(x.shape[1], noise))
v = np.full((N + 1, 2), np.nan)
v[0] = 0.0
channels["v"] = Channel(t, v, noise=np.ones(2), dropped="nan")

# %%
fig, axes = plt.subplots(1, 3, figsize=(11, 2.8), layout="constrained")
for ax, (name, unit) in zip(
    axes, {"q": "rad", "gyro:imu": "rad/s", "accelerometer:imu": "m/s²"}.items(), strict=True
):
    c = channels[name]
    for k, color in zip(range(c.values.shape[1]), (BLUE, ORANGE, GREEN), strict=False):
        ax.plot(c.t, c.values[:, k], ".", ms=2, color=color, label=("x", "y", "z")[k])
    ax.set(title=name, xlabel="t, s", ylabel=unit)
axes[0].legend(["shoulder", "elbow"])
axes[1].legend()
plt.show()

# %% [markdown]
# `Setup.with_sensors` says which sensors there are; each channel keeps its own clock. The first
# guess has another mass and another centre of mass, less friction, and no bias.

# %%
with warnings.catch_warnings(action="ignore"):
    truth = rb.load(ARM)
bodies, joints = truth.bodies, truth.joints
guess = truth.replace(
    bodies=bodies.replace(
        mass=bodies.mass.at[1].set(0.7), com=bodies.com.at[1].set(jnp.array([0.02, 0.0, -0.13]))
    ),
    joints=joints.replace(damping=0.5 * joints.damping),
)
link = {
    "mass": Unknown("bodies.mass", 1, positive=True),
    "com x": Unknown("bodies.com", (1, 0)),
    "com z": Unknown("bodies.com", (1, 2)),
    "friction": Unknown("joints.damping", positive=True),
}
true = {
    "mass": 0.6, "com x": 0.03, "com z": -0.15, "friction[shoulder]": 0.1, "friction[elbow]": 0.05,
}  # fmt: skip


def fitted(*sensors):
    setup = Setup.of(guess).with_sensors(*(s for s in sensors if ":" in s))
    bias = {"gyro bias": Unknown("sensors.gyro:imu.bias")} if "gyro:imu" in sensors else {}
    kept = dict(channels)
    if "q" not in sensors:  # only where it starts
        x = np.full_like(channels["q"].values, np.nan)
        x[0] = channels["q"].values[0]
        kept["q"] = Channel(channels["q"].t, x, noise=np.ones(2), dropped="nan")
    names = ("ctrl", "q", "v", *sensors)
    run = Recording("swing", {name: kept[name] for name in dict.fromkeys(names)})
    return sysid.identify(setup, run, link | bias, grid=Grid(T, 1, "rk4"))


fits = {
    "encoders": fitted("q"),
    "IMU": fitted("gyro:imu", "accelerometer:imu"),
    "both": fitted("q", "gyro:imu", "accelerometer:imu"),
}

# %%
names = list(fits["encoders"].values)
fig, ax = plt.subplots(figsize=(9, 3), layout="constrained")
for k, ((label, found), color) in enumerate(zip(fits.items(), (BLUE, ORANGE, GREEN), strict=True)):
    for j, name in enumerate(names):
        of = found.estimates.interval(name)
        size = abs(list(true.values())[j])
        off = 100 * (of.value - list(true.values())[j]) / size
        half = 100 * (of.high - of.low) / 2 / size
        ax.errorbar(j + 0.2 * (k - 1), off, half, fmt="o", ms=4, capsize=3, color=color,
                    label=label if j == 0 else None)  # fmt: skip
ax.axhline(0, color=INK, lw=0.8)
ax.set_xticks(range(len(names)), names)
ax.set_ylabel("estimate less truth, %")
ax.set_title("95 % intervals by sensor")
ax.legend()
plt.show()
found = fits["both"]
print("gyro bias:", [f"{found.values[n]:.4f}" for n in found.values if n.startswith("gyro")])

# %% [markdown]
# The IMU by itself finds the link, with no encoder after the start, and better than encoders do:
# its samples are many, and accelerations are near to forces. With it the encoders hardly add
# anything. The gyro's bias is one more unknown, and is found with the rest.
#
# A poor first guess would lose such a motion: an IMU tells no angles, so there is nothing to begin
# short pieces from. `many_starts` tries several.

# %%
for label, found in fits.items():
    print(f"{label}: {found.identifiable.summary()}")

# %% [markdown]
# ## A pendulum in gusts
#
# Now a pendulum, whose mass and friction are sought, moves in a wind: an unknown torque, another in
# each period of 20 ms. `identify` simulates from the first sample and calls all that remains noise
# of the sensor. But a gust moves the pendulum for long, so these errors are not independent, and
# the intervals are far too small. `prediction_error` predicts each sample from those before it (a
# Kalman filter), so that a gust counts once, and finds how strong the gusts are.

# %%
STEP, PUSH, SIGMA = 0.02, 0.3, 1e-3
EULER = "semi_implicit_euler"
wind_grid = Grid(STEP, 1, EULER)
swing = rb.load("pendulum")
swing = swing.replace(joints=swing.joints.replace(damping=jnp.array([0.3])))
start = rb.State(jnp.array([0.3]), jnp.array([0.2]))
clock = np.arange(301) * STEP
push = 4 * np.sin(3 * clock[:-1])[:, None]
unknowns = {
    "mass": Unknown("bodies.mass", 0, positive=True),
    "friction": Unknown("joints.damping", 0, positive=True),
}
run_windy = jax.jit(lambda u: rb.rollout(swing, start, u, STEP, integrator=EULER))


def windy(seed):
    rng = np.random.default_rng(seed)
    path = run_windy(jnp.asarray(push + PUSH * rng.normal(size=push.shape)))
    q = np.asarray(path.q) + SIGMA * rng.normal(size=path.q.shape)
    q[0] = path.q[0]
    return path, Recording(
        f"windy {seed}", {"q": Channel(clock, q, noise=[SIGMA]), "ctrl": Channel(clock[:-1], push)}
    )


first = swing.replace(
    bodies=swing.bodies.replace(mass=jnp.array([1.4])),
    joints=swing.joints.replace(damping=jnp.array([0.1])),
)
simulated, predicted = [], []
for seed in range(6):
    path, run = windy(seed)
    simulated.append(sysid.identify(first, run, unknowns, grid=wind_grid))
    predicted.append(sysid.prediction_error(first, run, unknowns, grid=wind_grid))

# %%
fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for ax, (name, value) in zip(axes, (("mass", 1.0), ("friction", 0.3)), strict=True):
    for k, (label, fits_of, color) in enumerate(
        (("simulation error", simulated, ORANGE), ("prediction error", predicted, BLUE))
    ):
        of = [fit.estimates.interval(name) for fit in fits_of]
        x = np.arange(len(of)) + 0.25 * k
        ax.errorbar(x, [i.value for i in of], [(i.high - i.low) / 2 for i in of], fmt="o", ms=4,
                    capsize=3, color=color, label=label)  # fmt: skip
    ax.axhline(value, color=INK, lw=0.8)
    ax.set(title=f"{name}, with 95 % intervals", xlabel="recording")
axes[0].legend()
plt.show()

# %% [markdown]
# The intervals of the simulation error miss the truth (black) in most recordings. The intervals of
# the prediction error are wider, and contain it about as often as they should. The same fit finds
# the strength of the gusts.
#
# The smoother estimates how the pendulum moved, and how fast, which no sensor measured.

# %%
interval = predicted[-1].estimates.interval("torque noise[hinge]")
print(f"gusts: {interval.value:.3f} N m ({interval.low:.3f} to {interval.high:.3f}), true {PUSH}")
smooth = predicted[-1].smoothed()[run.name]
speed = np.diff(run["q"].values[:, 0]) / STEP
fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
true_speed = np.asarray(path.v)[:, 0]
axes[0].plot(clock[1:], speed - true_speed[1:], color=ORANGE, lw=1, label="differences of q")
off = np.asarray(smooth.state.v)[:, 0] - true_speed
axes[0].plot(clock, off, color=BLUE, lw=1, label="smoother")
axes[0].set(title="error of the speed, rad/s", xlabel="t, s")
axes[0].legend()
white = predicted[-1].whitened()[run.name][1:, 0]
residual = simulated[-1].traces[run.name]["q"].residual[1:, 0] / SIGMA
for x, label, color in ((residual, "simulation", ORANGE), (white, "one-step prediction", BLUE)):
    x = x - x.mean()
    lags = np.arange(30)
    r = [float((x[: len(x) - k] * x[k:]).mean() / (x * x).mean()) for k in lags]
    axes[1].plot(lags * STEP, r, "o-", ms=3, lw=1, color=color, label=label)
axes[1].axhline(0, color=INK, lw=0.8)
axes[1].set(title="autocorrelation of the residual", xlabel="lag, s")
axes[1].legend()
plt.show()

# %% [markdown]
# Errors of the simulation are alike for some tenths of a second: they are a motion that the model
# does not have. Errors of the one-step prediction are white, as noise should be.
# `sysid.statistics.whiteness` says the same as a test.
