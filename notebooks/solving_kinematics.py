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
# # Solving kinematics, and holding a tool softly
#
# `rb.control.inverse_kinematics` finds joint angles that bring a tool to a pose, within the joint
# ranges. With seven joints there are many answers. Then two laws hold the tool: one follows a
# circle, one is a spring that a push displaces by force over stiffness.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.control import cartesian_impedance, inverse_kinematics, operational_space
from rbjax.plotting import STYLE, Camera, strobe

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

# %% [markdown]
# ## One pose
# The file of this arm states joint ranges without switching them on, so they are given here.

# %%
arm = rb.load("arm7")
ranges = [(-2.8, 2.8), (-1.8, 1.8), (-2.8, 2.8), (-0.1, 3), (-2.8, 2.8), (0, 3.7), (-2.8, 2.8)]
arm = arm.replace(joints=arm.joints.replace(range=jnp.array(ranges)))
down = jnp.diag(jnp.array([1.0, -1.0, -1.0]))  # the tool's z points down
place = jnp.array([0.45, 0.2, 0.4])
found = inverse_kinematics(arm, (down, place), site="tool")
print(found.summary())
print(found.q.round(3))

# %% [markdown]
# ## Many answers to one pose
# Five hundred searches begin at random. More than half find the pose from where they begin, in many
# postures: the elbow is free. The others go on from a second start, which is the same
# for all, and end there. All stay within the ranges.

# %%
low, high = arm.joints.range.T
starts = jax.random.uniform(jax.random.key(1), (500, 7), minval=low, maxval=high)


@jax.jit
@jax.vmap
def solved(R, p, q):
    """The pose (R, p) from a start q, and from up to 63 random ones after it."""
    return inverse_kinematics(arm, (R, p), site="tool", start=q, seeds=64)


many = solved(jnp.tile(down, (500, 1, 1)), jnp.tile(place, (500, 1)), starts)
print(many.summary(), "; within the ranges:", bool(((many.q >= low) & (many.q <= high)).all()))

own = many.q[many.start == 0]
print(len(own), "from their own start")

figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
for axis, camera in zip(axes[:2], (Camera(-60, 15), Camera(0, 15)), strict=True):
    strobe(arm, own[:6], ax=axis, source="arm7", camera=camera, shadow=False)
    axis.axis("off")
axes[0].set_title("six of the postures")
axes[1].set_title("the same from the front")
axes[2].hist(np.asarray(own[:, 2]), 25)
axes[2].set(xlabel="joint 3 [rad]", ylabel="searches")
figure.tight_layout()

# %% [markdown]
# ## Five hundred poses
# Poses of random configurations are within reach. One start often does not find the way; restarts
# do.

# %%
truth = jax.random.uniform(jax.random.key(2), (500, 7), minval=low, maxval=high)
poses = jax.vmap(lambda q: rb.frame_pose(arm, q, site="tool"))(truth)
batch = solved(*poses, starts)
for count in (1, 2, 4, 8, 64):
    share = float((batch.success & (batch.start < count)).mean())
    print(f"{100 * share:5.1f} % solved with at most {count} starts")

# %% [markdown]
# ## A circle, and a push
# `operational_space` makes the tool obey a second-order law about a function of time.
# `cartesian_impedance` makes it a spring of 400 N/m. From 1 s to 2.5 s, 20 N push the tool along y:
# the spring gives way by 20 / 400 m = 50 mm, and comes back.

# %%
start = rb.State(found.q, jnp.zeros(7))
hand = arm.body("link7")


def circle(t):
    """The tool's position: a circle of 0.1 m in the horizontal plane, every 2 s."""
    angle = jnp.pi * t
    return place + 0.1 * jnp.stack([jnp.cos(angle) - 1, jnp.sin(angle), 0 * t])


def push(t, state):
    """20 N at the tool, as wrenches [moment; force] at the bodies' origins."""
    lever = (
        rb.frame_pose(arm, state.q, site="tool")[1] - rb.forward_kinematics(arm, state.q).p[hand]
    )
    force = jnp.where((t > 1.0) & (t < 2.5), 20.0, 0.0) * jnp.array([0.0, 1.0, 0.0])
    wrench = jnp.concatenate([jnp.cross(lever, force), force])
    return jnp.zeros((len(arm.bodies.mass), 6)).at[hand].set(wrench)


spring = cartesian_impedance(
    arm, place, site="tool", task="position", stiffness=400.0, damping=80.0,
    posture=found.q, posture_stiffness=10.0, posture_damping=5.0,
)  # fmt: skip
follow = operational_space(arm, circle, site="tool", task="position", stiffness=200.0)
pushed = rb.rollout(arm, start, spring, 0.002, wrenches=push, steps=2000, save_every=10)
turned = rb.rollout(arm, start, follow, 0.002, steps=2000, save_every=10)
tool = jax.jit(jax.vmap(lambda q: rb.frame_pose(arm, q, site="tool")[1]))

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 3.4))
axes[0].axvspan(1.0, 2.5, color="0.9")
axes[0].plot(pushed.ts, 1e3 * (tool(pushed.q) - place), label=["x", "y", "z"])
axes[0].axhline(50.0, color="0.5", ls=":")
axes[0].set(xlabel="time [s]", ylabel="tool from its place [mm]", title="impedance, 20 N along y")
axes[0].legend()
path, due = tool(turned.q), jax.vmap(circle)(turned.ts)
axes[1].plot(due[:, 0], due[:, 1], "k--", lw=1, label="asked")
axes[1].plot(path[:, 0], path[:, 1], label="tool")
axes[1].set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="operational space")
axes[1].legend()
figure.tight_layout()
print(f"largest error after 1 s: {1e3 * float(jnp.abs(path - due)[50:].max()):.2f} mm")
