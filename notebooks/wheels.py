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
# # Wheels that roll, and wheels that slip
#
# `rb.wheeled` has robots on wheels. A robot is a record of bodies, wheels, drives and steerings. It
# runs at several fidelities, which share its coordinates and its controls.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import recommend, wheeled
from rbjax.plotting import STYLE, top_view

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

for name, kind in wheeled.kinds().items():
    found = kind.make().arrangement
    print(f"{name:20s} mobility {found.mobility}, steerability {found.steerability}")

# %% [markdown]
# ## A differential drive that coasts
#
# Its centre of mass is ahead of the axle. Without any torque it does not drive a circle: like
# Chaplygin's sleigh it turns ever less, and gains speed, at constant energy.

# %%
robot = wheeled.kinds()["differential_drive"].make(com=[0.15, 0.0], caster=None)
cart = wheeled.at(robot, "reduced")
path = wheeled.rollout(cart, wheeled.start(cart, twist=[0.5, 0.0, 2.5]), jnp.zeros((400, 2)), 0.01)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=[2, 1])
top_view(cart, path, ax=left, robots=6)
right.plot(path.ts, path.v, label=["speed [m/s]", "turning rate [rad/s]"])
right.set(xlabel="time [s]")
right.legend()
plt.show()

# %% [markdown]
# ## Three reductions, one motion
#
# The equations may be projected on the velocities that the wheels leave free, or solved with
# multipliers that are eliminated, or derived from energies by Boltzmann and Hamel. They agree with
# the full multibody model, whose wheels are bodies and whose contacts are constraints.

# %%
u = jnp.array([0.3, 0.1])
for name in ("reduced", "dynamical", "quasi_velocities", "constrained"):
    vehicle = wheeled.at(robot, name)
    rate = wheeled.rates(vehicle, wheeled.start(vehicle, twist=[0.5, 0.0, 2.5]), u)
    turning = rate.v[2] if vehicle.nv > 2 else rate.v[1]
    print(f"{name:18s} speed' = {rate.v[0]:+.12f}, turning rate' = {turning:+.12f}")

# %% [markdown]
# ## An omnidirectional robot that loses its grip
#
# Motors hold the wheels' speeds for a turn on the spot while it drives across. On rubber the robot
# does that. On ice its wheels slip: the arrows are the forces on them.

# %%
omni = wheeled.kinds()["omni_3"].make(motor=wheeled.SpeedServo(0.5, 1.0), wheel_mass=1.0)
twist = np.array([0.8, 0.0, 1.5])
speeds = wheeled.commands(omni, twist).speeds
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharex=True, sharey=True)
for ax, (name, friction) in zip(axes, {"rubber": 0.9, "ice": 0.08}.items(), strict=True):
    vehicle = wheeled.at(omni, "slipping", tyre=wheeled.Fiala(15.0, friction, smooth_speed=0.3))
    start = wheeled.start(vehicle)
    path = wheeled.rollout(vehicle, start, jnp.tile(speeds, (2000, 1)), 0.001, save_every=20)
    top_view(vehicle, path, ax=ax, robots=4, ctrl=speeds)
    ax.set_title(f"{name}, friction {friction}")
plt.show()

# %% [markdown]
# ## A car on a circle, by Stanley's law
#
# The car slips. The law sees where its front axle is; `commands` turns a twist into the speed of
# the rear axle and the steering angle.

# %%
radius, speed = 15.0, 8.0
angle = jnp.linspace(0, 2 * np.pi, 300)
circle = jnp.stack([radius * jnp.sin(angle), radius * (1 - jnp.cos(angle)), angle], -1)
car = wheeled.kinds()["car"].make(motor=wheeled.SpeedServo(2000.0), lag=0.1)


def control(t, state):
    wanted = wheeled.commands(car, wheeled.stanley(circle, state.q[:3], speed, 2.6))
    return jnp.concatenate([wanted.speeds, wanted.angles])


figure, ax = plt.subplots(figsize=(6, 5))
vehicle = wheeled.at(car, "slipping", tyre=wheeled.Fiala(15.0, 0.9, smooth_speed=1.0))
start = wheeled.start(vehicle, pose=[0.0, -1.5, 0.0], twist=[speed, 0.0, 0.0])
path = wheeled.rollout(vehicle, start, control, 0.002, steps=5000, save_every=100)
ax.plot(circle[:, 0], circle[:, 1], "--", lw=1, color="gray")
top_view(vehicle, path, ax=ax, robots=8)
plt.show()
found = wheeled.contacts(vehicle, path.state(-1), control(0.0, path.state(-1)))
print("loads of the wheels [N]:", np.round(found.loads))

# %% [markdown]
# ## How much to model
#
# Servos drive a cart along a curve. Must its tyres be modelled, or its inertia? `recommend` runs
# the manoeuvre at each fidelity, with steps that are halved until they agree, and names the
# cheapest whose error is below what is asked for.

# %%
servo = wheeled.SpeedServo(0.2)
driven = wheeled.kinds()["differential_drive"].make(caster=None, motor=servo)
tyre = wheeled.Fiala(20.0, 0.9, smooth_speed=0.3)
for accuracy in (0.1, 0.02, 1e-4):
    found = recommend.fidelity(
        driven, [5.0, 6.0], accuracy, twist=[0.4, 0.0, 0.0], horizon=2.0, tyre=tyre, progress=False
    )
    print(f"{found.name}: {found.reason}", end="\n\n")

# %% [markdown]
# ## Gradients
#
# Everything is differentiable, with respect to any number of the robot: here, where the coasting
# cart of above ends, by the place of its centre of mass and by a radius.

# %%


def end(robot):
    vehicle = wheeled.at(robot, "reduced")
    start = wheeled.start(vehicle, twist=[0.5, 0.0, 2.5])
    return wheeled.rollout(vehicle, start, jnp.zeros((100, 2)), 0.04).q[-1, 0]


slope = jax.grad(end)(robot)
print("end by the place of the centre of mass:", slope.bodies[0].com, "m/m")
print("and by the radius of the right wheel:", slope.wheels[0].radius, "m/m")
