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
# # Contact
#
# `rb.load` reads the contacts, limits and friction loss of a file. `rb.step`, `rb.rollout` and
# `rb.simulate` then move the robot on the ground. A box falls, slides and stands on a ramp under
# two contact laws. A quadruped walks, a gripper lifts a cube, and a ball bounces, with the
# derivative of the bounce by the height of its fall. `docs/guides/contacts.md` lists the laws with
# their limits.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE, Camera, draw, strobe

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)
G, MU, DT = 9.81, 0.5, 2e-3
list(rb.contact.laws())

# %% [markdown]
# ## Drop
#
# A box of 1 kg starts 0.6 m above the floor, turned about all axes. `model.contact` is the law that
# the functions of motion use. `model.dropped` lists the features of the file that are left out.

# %%
model = rb.load(
    f"""<mujoco><option cone="elliptic"/><default><geom friction="{MU}"/></default><worldbody>
    <geom type="plane" size="0 0 1"/><body name="box" pos="0 0 0.1"><freejoint/>
    <geom type="box" size="0.1 0.1 0.1" mass="1"/></body></worldbody></mujoco>"""
)
print("law:", model.contact, " left out:", model.dropped)
turned = np.array([0.95, 0.2, 0.15, 0.1])
above = rb.State(jnp.array([0.0, 0.0, 0.6, *turned / np.linalg.norm(turned)]), jnp.zeros(6))
drop = rb.rollout(model, above, None, DT, steps=1000, save_every=5)
print("height at the end", float(drop.q[-1, 2]), "m, speed", float(abs(drop.v[-1]).max()))

# %% [markdown]
# `rb.contact.solve` returns the forces at a state: one row for each candidate contact, with the
# normal force first, in the axes of the contact. The law is a convex problem, and the result
# contains the iterations and the error of its solver. At rest the normal forces sum to the weight.

# %%
solve = jax.jit(jax.vmap(lambda q, v: rb.contact.solve(model, rb.State(q, v))))
found = solve(drop.q, drop.v)
normal = found.contacts.force[:, :, 0].sum(1)
print("contacts at rest   ", int(found.contacts.exists[-1].sum()))
print("normal force       ", float(normal[-1]), "N, weight", G, "N")
print("most Newton steps  ", int(found.iterations.max()), " all converged:", found.success.all())

# %% [markdown]
# ## Slide
#
# The box is launched along the floor at three speeds. Coulomb's law gives v^2 / (2 mu g) for the
# distance to the stop. The default contact is soft, and a box that starts without penetration first
# sinks in. `contact=` chooses another law for a run.

# %%
speeds = jnp.array([1.0, 2.0, 3.0])
rest = model.default_state()
launch = rb.State(jnp.tile(rest.q, (3, 1)), jnp.zeros((3, 6)).at[:, 0].set(speeds))
LAWS = "mujoco", "coulomb"


def slide(model, law):
    return rb.rollout(model, launch, None, DT, steps=1000, contact=law, save_every=5)


flat = {law: slide(model, law) for law in LAWS}
for law, path in flat.items():
    stop = np.asarray(path.q[:, -1, 0])
    print(f"{law:8}", stop.round(4), "m, over v^2 / (2 mu g):", (stop / speeds**2 * 2 * MU * G))

# %% [markdown]
# ## Two laws on a ramp
#
# The same box slides down a ramp of 15 degrees and stops, because mu is above tan(15 degrees). The
# ramp is a floor with tilted gravity: a changed leaf of the model compiles nothing again. MuJoCo's
# law has no sticking: friction is a damper with a large coefficient, so the box creeps. The law
# `coulomb` keeps the place at which a contact began to stick (`State.memory`), and the box stays.

# %%
tilt = np.deg2rad(15)
ramp = model.replace(gravity=G * jnp.array([np.sin(tilt), 0.0, -np.cos(tilt)]))
down = {law: slide(ramp, law) for law in LAWS}
brake = G * (MU * np.cos(tilt) - np.sin(tilt))
print("closed form of the stop", np.asarray(speeds**2 / (2 * brake)).round(4), "m")
for law, path in down.items():
    print(f"{law:8} {np.asarray(path.q[:, -1, 0]).round(4)} m, speed at the end", path.v[:, -1, 0])

# %%
figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.2), layout="constrained")
axes[0].plot(drop.ts, drop.q[:, 2], label="height, m")
axes[0].plot(drop.ts, normal / G, lw=0.8, label="normal force, weights")
axes[0].set(xlabel="t, s", title="A box falls", ylim=(0, 6))
line = np.linspace(0, 3.2, 50)
axes[1].plot(line, line**2 / (2 * MU * G), lw=0.8, color="k", label="closed form")
for law, mark in zip(LAWS, "ox", strict=True):
    axes[1].plot(speeds, flat[law].q[:, -1, 0], mark, label=law)
    axes[2].semilogy(down[law].ts, np.abs(down[law].v[0, :, 0]) + 1e-18, label=law)
axes[1].set(xlabel="speed, m/s", ylabel="m", title="Distance to the stop")
axes[2].set(xlabel="t, s", ylabel="speed, m/s", title="Creep on a ramp")
for axis in axes:
    axis.legend()

# %% [markdown]
# ## Walk
#
# The geoms of the bundled scenes do not touch. A `ModelBuilder` has the scene as a `mujoco.MjSpec`:
# here the feet are given the collision masks to touch the floor, and the motors become servos of
# the joint angles. The angles of a trot are their controls. Diagonal legs swing together, a foot on
# the ground moves back by the length of a stride, and no state is fed back. Three robots with three
# strides are one batch.

# %%
builder = rb.ModelBuilder("quadruped")
for geom in builder.spec.geoms:
    geom.contype = int(geom.name.endswith("foot"))
    geom.conaffinity = int(geom.name == "floor")
for motor in builder.spec.actuators:
    motor.forcerange, motor.ctrlrange = motor.ctrlrange, [-3, 3]
    motor.set_to_position(kp=200, kv=5)
walker = builder.build()
LEG, HEIGHT, PERIOD = 0.22, 0.363, 0.4  # of thigh and shank, of the hip, of a step and a swing


def trot(t, stride):
    """The angles of abduction, hip and knee of four legs, whose hips are HEIGHT above the feet."""
    phase = (t / PERIOD + jnp.array([0.0, 0.5, 0.5, 0.0])) % 1.0
    swing, s, grown = phase < 0.5, 2 * phase % 1.0, jnp.minimum(t / 0.8, 1.0)
    x = grown * stride * jnp.where(swing, -0.5 * jnp.cos(jnp.pi * s), 0.5 - s)
    z = grown * jnp.where(swing, 0.06 * jnp.sin(jnp.pi * s) ** 2, 0.0) - HEIGHT
    knee = -2 * jnp.arccos(jnp.hypot(x, z) / (2 * LEG))
    return jnp.stack([0 * x, jnp.arctan2(-x, -z) - knee / 2, knee], -1).ravel()


strides = jnp.array([0.1, 0.2, 0.3])
times = DT * jnp.arange(2000)
angles = jax.vmap(lambda stride: jax.vmap(lambda t: trot(t, stride))(times))(strides)
three = jax.tree.map(lambda x: jnp.tile(x, (3, 1)), walker.keyframe("stand"))
walk = rb.rollout(walker, three, angles, DT, save_every=5)
print("speed of the feet", np.asarray(2 * strides / PERIOD).round(2), "m/s")
mean = (walk.q[:, -1, 0] - walk.q[:, 200, 0]) / (walk.ts[-1] - walk.ts[200])
print("speed of the trunk", np.asarray(mean).round(2), "m/s")
print("height of the trunk", np.asarray(walk.q[:, 200:, 2].min(1)).round(3), "m at least")

# %% [markdown]
# The forces on the feet at the saved states, for the second robot. The servos read their controls,
# so the state alone does not determine a force.

# %%
step = jax.jit(jax.vmap(lambda q, v, u: rb.contact.solve(walker, rb.State(q, v), u)))
feet = step(walk.q[1, :-1], walk.v[1, :-1], angles[1, ::5])
weight = G * float(walker.bodies.mass.sum())
held = float(feet.contacts.force[200:, :, 0].sum(1).mean())
print("mean of the normal forces", round(held, 1), "N, weight", round(weight, 1), "N")
print("all converged", bool(feet.success.all()))

figure, axes = plt.subplots(2, 1, figsize=(9.6, 5), layout="constrained")
strobe(walker, walk.q[1, 40::72], ax=axes[0], source=builder.spec, camera=Camera(-80, 10))
axes[0].set(title="A trot of 4 s, stride 0.2 m")
names = "front left", "front right", "hind left", "hind right"
for k, name in enumerate(names):
    axes[1].plot(walk.ts[300:380], feet.contacts.force[300:380, k, 0] / weight, label=name)
axes[1].set(xlabel="t, s", title="Normal forces over the weight")
axes[1].legend(loc="center left", bbox_to_anchor=(1, 0.5))

# %% [markdown]
# ## Grasp
#
# Two fingers press on a cube with 5 N each, and the hand lifts it by 15 cm. Only friction holds the
# cube: 2 mu 5 N = 8 N against its weight of 2 N. Under MuJoCo's law the cube creeps out of the
# hand. Under `coulomb` it stays.

# %%
GRIPPER = """<mujoco><option cone="elliptic"/><default><geom friction="0.8"/></default><worldbody>
  <geom type="plane" size="0.3 0.3 1"/>
  <body name="hand" pos="0 0 0.16"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.07 0.02 0.015" mass="0.5" contype="0" conaffinity="0"/>
    <body name="left" pos="-0.05 0 -0.07"><joint name="left" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.006 0.015 0.055" mass="0.1" rgba="0.16 0.4 0.7 1"/></body>
    <body name="right" pos="0.05 0 -0.07"><joint name="right" type="slide" axis="-1 0 0"/>
      <geom type="box" size="0.006 0.015 0.055" mass="0.1" rgba="0.16 0.4 0.7 1"/></body></body>
  <body name="cube" pos="0 0 0.025"><freejoint/>
    <geom type="box" size="0.025 0.025 0.025" mass="0.2" rgba="0.93 0.5 0.15 1"/></body></worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <actuator><position joint="lift" kp="2000" kv="110"/>
    <motor joint="left"/><motor joint="right"/></actuator></mujoco>"""
gripper = rb.load(GRIPPER)
seconds = DT * jnp.arange(1500)
lift = 0.15 * jnp.clip((seconds - 0.3) / 0.7, 0.0, 1.0)
commands = jnp.stack([lift, jnp.full(1500, 5.0), jnp.full(1500, 5.0)], -1)
grasp = {
    law: rb.rollout(gripper, gripper.default_state(), commands, DT, contact=law, save_every=5)
    for law in LAWS
}
slip = {law: path.q[:, 5] - path.q[:, 0] for law, path in grasp.items()}  # of cube in hand
for law in LAWS:
    print(f"{law:8} slip from 1.5 to 3 s: {float(slip[law][-1] - slip[law][150]):+.1e} m")

# %%
last = grasp["mujoco"].state(-1)
touches = rb.contact.solve(gripper, last, commands[-1]).contacts
figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.2), layout="constrained")
draw(gripper, gripper.default_state(), ax=axes[0], source=GRIPPER, camera=Camera(-70, 12))
draw(gripper, last, ax=axes[1], source=GRIPPER, camera=Camera(-70, 12), contacts=touches)
axes[0].set(title="Before")
axes[1].set(title="After, with contact forces")
for law in LAWS:
    axes[2].plot(grasp[law].ts, 1e3 * (slip[law] - slip[law][150]), label=law)
axes[2].set(xlabel="t, s", ylabel="mm", title="Slip of the cube in the hand", ylim=(-3, 3))
axes[2].legend()

# %% [markdown]
# ## The gradient of a bounce
#
# A ball flies towards the floor at 1 m/s, without gravity. Its height after the bounce falls by e
# for each metre of additional height before: dz/dh = -e, with the restitution e. A step of 2 ms
# samples the contact at a place that depends on h, so the slope is taken at eight heights within
# one step, by forward mode.

# %%
ball = rb.load(
    """<mujoco><option gravity="0 0 0"/><worldbody><geom type="plane" size="0 0 1"/>
    <body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1"/></body>
    </worldbody></mujoco>"""
)
heights = jnp.asarray(0.05 + DT * np.arange(8) / 8)


@jax.jit
def bounce(model):
    """The speed after the bounce, and the slope of the height, for each height of the start."""

    def after(h):
        start = rb.State(jnp.stack([h]), -jnp.ones(1))
        end = rb.rollout(model, start, None, DT, steps=250, integrator="rk4").state(-1)
        return end.q[0], end.v[0]

    def one(h):
        (_, speed), (slope, _) = jax.jvp(after, (h,), (jnp.ones_like(h),))
        return speed, slope

    return jax.vmap(one)(heights)


def report(name, model):
    speed, slope = bounce(model)
    print(f"{name:12} e {speed.mean():.4f}, slope {slope.mean():+.4f} +- {slope.std():.4f}")


report("default", ball)

# %% [markdown]
# The default law is wrong here at every step size. Its damper acts at full strength at touch, and
# the depth of the first active step changes with h. Two cures have a force that is continuous at
# touch: an impedance that begins near zero (`solimp`, a leaf of the model), and the force element
# `rb.contact.CompliantContact` (Hunt and Crossley) in place of the law. `rb.simulate_impacts`
# integrates from impact to impact, with derivatives that are exact.

# %%
solimp = jnp.tile(jnp.array([1e-4, 0.95, 0.02, 0.5, 2.0]), (2, 1))
report("soft ramp", ball.replace(geoms=ball.geoms.replace(solimp=solimp)))
free = ball.replace(contact=None)
element = rb.contact.CompliantContact.of(free, stiffness=3e3, dissipation=0.4, exponent=2.0)
report("compliant", free.with_forces(element))
