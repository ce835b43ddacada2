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
# # The first hour with rbjax
#
# A robot file goes in and motion comes out, for one sample or a batch of a million. Every number
# of the robot has a gradient. This notebook loads a double pendulum, lets three hundred of them
# fall at once, and looks at their energy. Then the gradient answers two questions: which control
# brings a cart-pole's cart to a mark, and which mass explains a measured swing.

# %%
# Where rbjax is missing, as on Colab: install the wheel in this folder, or from the package index.
import importlib.util
import subprocess
import sys
from pathlib import Path

if importlib.util.find_spec("rbjax") is None:
    newest = max([f"./{path}" for path in Path().glob("rbjax-*.whl")], default="rbjax")
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", f"{newest}[plots]"], check=True)

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

# %% [markdown]
# ## A file becomes a model
# Bundled scenes have names; a path to any MJCF or URDF works the same way. The model is a pytree:
# its leaves are masses, lengths, gains and gravity.

# %%
model = rb.load("double_pendulum")
print(rb.scenes())
print(model.joint_names, model.bodies.mass, model.gravity)

# %% [markdown]
# ## Three hundred pendula, almost in the same place
# `rollout` takes a batch as a leading axis. The pendula start within a tenth of a degree of each
# other. A double pendulum is chaotic, and a few seconds are enough to see it.

# %%
count, steps, dt = 300, 4000, 0.002
start = model.default_state()
tilt = jnp.array([2.0, 2.4]) + jnp.linspace(-1, 1, count)[:, None] * jnp.deg2rad(0.05)
states = rb.State(start.q + tilt, jnp.zeros((count, 2)))
fan = rb.rollout(model, states, None, dt, integrator="rk4", steps=steps, save_every=10)

figure, axis = plt.subplots(figsize=(8, 3.4))
colours = plt.get_cmap("viridis")(np.linspace(0, 1, count))
for i in range(0, count, 3):
    axis.plot(fan.ts, np.rad2deg(fan.q[i, :, 1]), color=colours[i], lw=0.5, alpha=0.6)
axis.set(xlabel="time [s]", ylabel="elbow [deg]", title="300 double pendula")
figure.tight_layout()

# %% [markdown]
# ## The energy shows the quality of the steps
# Nothing dissipates energy here, so its change is the integrator's error. With steps of 2 ms, in
# this violent motion, the error of RK4 is below a millionth. The error of semi-implicit Euler, a
# method of first order, is a tenth.

# %%
energy = jax.jit(
    jax.vmap(lambda q, v: rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q))
)
figure, axis = plt.subplots(figsize=(8, 3))
one = rb.State(states.q[0], states.v[0])
for name in ("semi_implicit_euler", "rk4"):
    run = rb.rollout(model, one, None, dt, integrator=name, steps=steps, save_every=10)
    e = energy(run.q, run.v)
    axis.semilogy(run.ts[1:], np.abs(e - e[0])[1:] / np.ptp(energy(run.q, 0 * run.v)), label=name)
axis.set(xlabel="time [s]", ylabel="energy error, relative", title="one pendulum, step 2 ms")
axis.legend()
figure.tight_layout()

# %% [markdown]
# ## Which push brings the cart to the mark?
# The gradient of a rollout with respect to its controls is one reverse pass. A few hundred steps of
# gradient descent move the cart 0.3 m in one second and leave it, and the pole, at rest.

# %%
cart = rb.load("cart_pole")
hanging = cart.keyframe("down") if "down" in cart.keyframe_names else cart.default_state()
horizon = 100


@jax.jit
def miss(ctrls):
    run = rb.rollout(cart, hanging, ctrls, 0.01)
    goal = hanging.q.at[0].add(0.3)
    return ((run.q[-1] - goal) ** 2).sum() + 0.1 * (run.v[-1] ** 2).sum() + 1e-7 * (ctrls**2).sum()


import optax

ctrls = jnp.zeros((horizon, cart.nu))
optimiser = optax.adam(0.3)
memory = optimiser.init(ctrls)
slope = jax.jit(jax.value_and_grad(miss))
losses = []
for _ in range(600):
    value, gradient = slope(ctrls)
    change, memory = optimiser.update(gradient, memory)
    ctrls = optax.apply_updates(ctrls, change)
    losses.append(float(value))

run = rb.rollout(cart, hanging, ctrls, 0.01)
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
left.semilogy(losses)
left.set(xlabel="iteration", ylabel="cost", title="gradient through the rollout")
right.plot(run.ts, run.q[:, 0] - hanging.q[0], label="cart [m]")
right.plot(run.ts, run.q[:, 1] - hanging.q[1], label="pole, from hanging [rad]")
right.axhline(0.3, color="k", lw=0.8, ls=":")
right.set(xlabel="time [s]", title="the motion found")
right.legend(loc="lower left", fontsize=8)
figure.tight_layout()
print(f"cart at {float(run.q[-1, 0] - hanging.q[0]):.4f} m, asked 0.3 m")

# %% [markdown]
# ## Which mass explains the measurement?
# Masses are leaves, so the same gradient identifies them. The data are the noisy angles of a double
# pendulum with a 30 % larger lower mass. Gauss-Newton steps find this mass.

# %%
true_mass = model.bodies.mass * jnp.array([1.0, 1.3])
rng = np.random.default_rng(0)


@jax.jit
def swing(mass):
    heavier = model.replace(bodies=model.bodies.replace(mass=mass))
    start = rb.State(jnp.array([0.6, -0.4]), jnp.zeros(2))
    return rb.rollout(heavier, start, None, 0.005, steps=200).q


measured = swing(true_mass) + 2e-3 * rng.normal(size=(201, 2))
sensitivity = jax.jit(jax.jacfwd(swing))
mass = model.bodies.mass
trace = [mass]
for _ in range(6):
    J = np.asarray(sensitivity(mass)[..., 1]).reshape(-1, 1)  # the lower mass alone
    step = np.linalg.lstsq(J, np.asarray(measured - swing(mass)).reshape(-1), rcond=None)[0]
    mass = mass.at[1].add(float(step[0]))
    trace.append(mass)

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
ts = 0.005 * np.arange(201)
left.plot(ts, measured[:, 1], ".", ms=2, label="measured")
left.plot(ts, swing(model.bodies.mass)[:, 1], label="before")
left.plot(ts, swing(mass)[:, 1], label="after")
left.set(xlabel="time [s]", ylabel="elbow [rad]", title="the swing explained")
left.legend(loc="lower left", fontsize=8)
right.plot([float(m[1]) for m in trace], "o-")
right.axhline(float(true_mass[1]), color="k", lw=0.8, ls=":")
right.set(xlabel="Gauss-Newton step", ylabel="lower mass [kg]", title="the mass found")
figure.tight_layout()
print(f"lower mass {float(mass[1]):.4f} kg, true {float(true_mass[1]):.4f} kg")
