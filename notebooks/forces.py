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
# # Your own forces
#
# A model has a tuple of force elements. `rollout`, `simulate`, `linearise` and their derivatives
# sum over them, for one robot or a batch. The guide is `docs/develop/extending.md`.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax.plotting import STYLE

plt.rcParams.update(STYLE)
jax.config.update("jax_enable_x64", True)
robot = rb.load("pendulum")
start = robot.keyframe("horizontal")


# %% [markdown]
# ## An element in a few lines
#
# Its fields are parameters of the model. `loads(context)` returns its forces at an instant. Here a
# fan blows at the pendulum's bob, with a drag that grows with the square of the relative speed.


# %%
class Fan(rb.forces.Element):
    air: jax.Array  # (3,) m/s
    drag: jax.Array  # N s^2 / m^2

    def loads(self, context):
        bob = context.body(0).at(context.model.bodies.com[0])  # the body's own origin is its pivot
        wind = self.air - bob.velocity
        return bob.push(wind * (self.drag * wind.norm(1e-6)))


fan = Fan(jnp.array([6.0, 0.0, 0.0]), jnp.array(0.05))
ts = jnp.linspace(0.0, 6.0, 301)
still = rb.simulate(robot, start, ts)
blown = rb.simulate(robot.with_forces(fan), start, ts)

# %% [markdown]
# ## Friction, stops, and the library
#
# Dry friction is smooth at rest. Stops push and never pull. Both are elements of the library, with
# numbers that can be differentiated.

# %%
dry = rb.forces.JointFriction.of(robot, robot.joint_names, coulomb=0.4)
limited = robot.replace(joints=robot.joints.replace(range=[[-0.8, 2.0]]))
stops = rb.forces.JointLimits(*(jnp.array([x]) for x in (2e3, 20.0, 0.0, 0.01)), robot.joint_names)
rubbed = rb.simulate(robot.with_forces(dry), start, ts)
stopped = rb.simulate(limited.with_forces(stops), start, ts)

fig, ax = plt.subplots(figsize=(7, 3.2))
for path, name in [
    (still, "alone"),
    (blown, "in a wind"),
    (rubbed, "dry friction"),
    (stopped, "a stop at -0.8 rad"),
]:
    ax.plot(ts, path.q[:, 0], label=name)
ax.set(xlabel="s", ylabel="rad")
ax.legend(ncol=4, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
fig.tight_layout()


# %% [markdown]
# ## An element with a state
#
# A motor that follows its command with a delay has one state, the torque. `State.x` holds it, and
# every solver integrates it with q and v.


# %%
class LateMotor(rb.forces.Element):
    delay: jax.Array  # s
    size = 1

    def loads(self, context):
        return context.joint(0).push(context.x[0])

    def rate(self, context):
        return [(2.0 * jnp.sin(3.0 * context.t) - context.x[0]) / self.delay]


driven = robot.with_forces(LateMotor(jnp.array(0.3)))
path = rb.simulate(driven, rb.State(start.q, start.v), ts)
path.x.shape

# %% [markdown]
# ## Gradients
#
# How much does the last angle change with the wind, and with the friction?


# %%
def last_angle(elements):
    model = robot.with_forces(*elements)
    return rb.rollout(model, start, None, 0.01, steps=200).q[-1, 0]


slope = jax.grad(last_angle)((fan, dry))
print("by the wind, rad s/m:", slope[0].air.round(4))
print("by Coulomb's friction, rad/(N m):", slope[1].coulomb.round(4))

# %% [markdown]
# ## Linearisation with all forces
#
# The wind damps the pendulum: the real part of the eigenvalues shows how much.

# %%
rest = rb.stability.equilibrium(robot.with_forces(fan), robot.default_state())
A, B = rb.linearise(robot.with_forces(fan), rest, jnp.zeros(robot.nu))
print("at rest at", rest.q.round(4), "rad, eigenvalues", jnp.linalg.eigvals(A).round(3))
