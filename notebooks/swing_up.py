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
# # Swinging up, by every method
#
# A cart-pole and an acrobot hang and shall stand. Their drives are too weak to lift them at once,
# so they must swing. Every method of `rb.control` gets the same problem and the same first guess:
# no force at all. A linear regulator about upright then catches the robot.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.control import Control, Cost, Problem, StateError, feedback, lqr_at, solve
from rbjax.plotting import STYLE, Camera, strobe

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

# %% [markdown]
# ## The cart-pole
# Three seconds, forces of at most 6 N, and a cost of the effort and of where it ends.

# %%
cart = rb.load("cart_pole")
up, down = cart.keyframe("up"), cart.keyframe("down")
problem = Problem(
    cart, 60, 0.05, bounds=(-6.0, 6.0),
    running=[Cost(Control(), 0.02)], terminal=[Cost(StateError(up), 100.0)],
)  # fmt: skip
swing = solve(problem, down)
print(swing.summary(), "after", int(swing.iterations), "iterations, cost", float(swing.cost))

# %% [markdown]
# ## Every method
# The registry says what there is. Of the schemes of collocation, which differ in their order, one
# is shown. Seconds are of the first call, compiling included, and of one more. The angle, in rad,
# is the distance from upright: a method has swung the pole up where it is small. Compiling
# takes seconds, solving far less: other weights, bounds and starts compile nothing.

# %%
print(f"{'method':20} {'cost':>8} {'angle':>7} {'rounds':>7} {'first':>7} {'again':>9}  status")
found = {}
for name in rb.control.methods():
    if name.startswith(("gauss_legendre", "radau", "trapezoidal")):
        continue
    spent = []
    for _ in range(2):
        began = time.perf_counter()
        one = jax.block_until_ready(solve(problem, down, method=name, iterations=300))
        spent.append(time.perf_counter() - began)
    found[name] = one
    left = float(one.states.q[-1, 1])
    print(
        f"{name:20} {float(one.cost):8.3f} {left:7.3f} {int(one.iterations):7} "
        f"{spent[0]:5.1f} s {1e3 * spent[1]:6.1f} ms  {one.summary().split(':')[0]}"
    )

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 3.4))
styles = ["-", "--", "-.", ":"]
for i, (name, one) in enumerate(found.items()):
    style = styles[i % 4]
    if abs(one.states.q[-1, 1]) < 0.3:
        axes[0].plot(one.ts, np.rad2deg(one.states.q[:, 1]), style, label=name, lw=1.5)
        axes[1].step(one.ts[:-1], one.ctrl[:, 0], ls=style, where="post", lw=1.5)
axes[0].set(xlabel="time [s]", ylabel="pole from upright [deg]")
axes[1].set(xlabel="time [s]", ylabel="force [N]")
axes[0].legend(fontsize=7)
figure.tight_layout()

# %% [markdown]
# ## Caught
# `lqr_at` linearises the model about upright and solves the Riccati equation. A policy follows the
# swing with the solution's feedback, and then holds with the regulator. The start is off by 0.05
# rad, so the forces of the plan do not bring the pole up.


# %%
def caught(model, one, held, Q, R, dt):
    """A policy: the swing, then the regulator about `held`."""
    follow = one.policy()
    K = lqr_at(model, held, jnp.zeros(model.nu), Q, R, dt=dt).K
    hold = feedback(model, held, jnp.zeros(model.nu), K)
    return lambda t, state: jnp.where(t < one.duration - dt / 2, follow(t, state), hold(t, state))


hang = rb.State(down.q.at[1].add(0.05), down.v)
policy = caught(cart, swing, up, jnp.array([10.0, 10.0, 1.0, 1.0]), jnp.array([0.1]), 0.05)
held = rb.rollout(cart, hang, policy, 0.05, steps=120)
blind = rb.rollout(cart, hang, jnp.concatenate([swing.ctrl, jnp.zeros((60, 1))]), 0.05)

figure, axes = plt.subplots(2, 1, figsize=(10, 6), height_ratios=[1.5, 1])
strobe(cart, held.q[:61:3], ax=axes[0], source="cart_pole", camera=Camera(-90, 5), shadow=False)
axes[0].axis("off")
for name, run in {"feedback, then LQR": held, "open loop": blind}.items():
    axes[1].plot(run.ts, np.rad2deg(run.q[:, 1]), label=name)
axes[1].axvline(3.0, color="0.6", ls=":")
axes[1].set(xlabel="time [s]", ylabel="pole from upright [deg]", ylim=(-200, 300))
axes[1].legend()
figure.tight_layout()

# %% [markdown]
# ## The acrobot
# Two rods of 1 m, and a motor of 4 N m at the elbow only. Nothing turns the shoulder: the lower rod
# pumps the swing. The first guess is again no torque at all.

# %%
ACROBOT = """
<mujoco model="acrobot">
  <compiler angle="radian"/>
  <default><geom size="0.04" mass="1" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper" pos="0 0 2.2">
      <joint name="shoulder" axis="0 -1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" rgba="0.16 0.40 0.70 1"/>
      <body name="lower" pos="0 0 -1">
        <joint name="elbow" axis="0 -1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -1" rgba="0.93 0.50 0.15 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="elbow" ctrllimited="true" ctrlrange="-4 4"/></actuator>
</mujoco>
"""
acrobot = rb.load(ACROBOT)
upright = rb.State(jnp.array([jnp.pi, 0.0]), jnp.zeros(2))
swings = Problem(
    acrobot, 200, 0.025,
    running=[Cost(Control(), 0.02)], terminal=[Cost(StateError(upright), 100.0)],
)  # fmt: skip
risen = solve(swings, acrobot.default_state(), iterations=1000, tolerance=1e-6)
print(risen.summary(), "after", int(risen.iterations), "iterations, cost", float(risen.cost))
print("at 5 s:", risen.states.q[-1], risen.states.v[-1])

# %%
Q, R = jnp.array([10.0, 10.0, 1.0, 1.0]), jnp.array([1.0])
policy = caught(acrobot, risen, upright, Q, R, 0.025)
stands = rb.rollout(acrobot, acrobot.default_state(), policy, 0.025, steps=320)
torque = jax.vmap(policy)(stands.ts[:-1], rb.State(stands.q[:-1], stands.v[:-1]))

figure, axes = plt.subplots(1, 5, figsize=(12, 3))
for k, axis in enumerate(axes):  # a second each
    moments = np.arange(40 * k, 40 * k + 41, 8)
    strobe(acrobot, stands.q[moments], ax=axis, source=ACROBOT, camera=Camera(-90, 0), shadow=False)
    axis.set(title=f"{k} to {k + 1} s", xlim=(-2.1, 2.1), ylim=(0.0, 4.4))
    axis.axis("off")
figure.tight_layout()

figure, axes = plt.subplots(1, 2, figsize=(11, 3))
axes[0].plot(stands.ts, np.rad2deg(stands.q), label=["shoulder", "elbow"])
axes[1].step(stands.ts[:-1], torque, where="post")
axes[0].set(xlabel="time [s]", ylabel="angle [deg]")
axes[1].set(xlabel="time [s]", ylabel="torque [N m]")
axes[0].axvline(5.0, color="0.6", ls=":")
axes[0].legend()
figure.tight_layout()
