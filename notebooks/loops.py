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
# # Loops
#
# A constraint is part of the model. It comes from the file (`<connect>`, `<weld>`, `<joint>`, a
# URDF's `mimic`) or from `model.with_constraints(...)`. `rollout`, `simulate`, `step` and
# `linearise` enforce it.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax import constraints as rc

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Closing a four-bar
#
# In the bundled scene `four_bar` two rods stand on a beam, 1 m apart. A third one, the coupler,
# hangs on the tip of the left rod. A `<connect>` at its end closes the loop. Here the loop is taken
# off and closed again by hand, with a ball joint. The loop is planar, so one of the three rows of
# the joint says nothing: redundant rows need no care.

# %%
tree = rb.load("four_bar").replace(constraints=())
ball = rc.Spherical.between(tree, "coupler", "right", point=[1.0, 0.0, 2.3])
model = tree.with_constraints(ball)
start = model.keyframe("turning")
print(rc.residual(model, start))
print(rc.jacobian(model, start.q).round(3))

# %% [markdown]
# ## Through the dead points
#
# The parallelogram is flat twice a turn. There the rows lose rank and another branch begins. A
# fixed step in f64 passes; a step that adapts to the error gets stuck, and in f32 energy jumps.

# %%
path = rb.rollout(model, start, None, 1e-3, steps=4000, integrator="rk4", save_every=20)
energy = jax.vmap(lambda q, v: rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q))
E = energy(path.q, path.v)
gap = jax.vmap(lambda q, v: jnp.abs(rc.residual(model, rb.State(q, v)).value).max())
print("energy kept to", float(abs(E - E[0]).max()), "J; gap", float(gap(path.q, path.v).max()), "m")

# %%
forces = jax.vmap(lambda q, v: rc.joint_wrenches(model, rb.State(q, v))[0, 3:])(path.q, path.v)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(path.ts, path.q[:, 0] / (2 * jnp.pi))
left.set(xlabel="t, s", ylabel="turns of the left rod")
right.plot(path.ts, forces[:, 0], label="x")
right.plot(path.ts, forces[:, 2], label="z")
right.set(xlabel="t, s", ylabel="force on the right rod, N")
right.legend(frameon=False)

# %% [markdown]
# ## A link length from a measured motion
#
# Where the ball sits on the coupler is a number of the model. Someone measures the left rod for
# half a second. The derivative of the motion by the length goes through the loop.


# %%
def with_length(length):
    place = ball.a.replace(position=jnp.zeros(3).at[0].set(length))
    return tree.with_constraints(ball.__class__(place, ball.b))


def angles(length):
    longer = with_length(length)
    begin = rc.Projected(iterations=8).settled(longer, 0.0, start)
    return rb.rollout(longer, begin, None, 2e-3, steps=250, integrator="rk4").q[::10, 0]


both = jax.jit(lambda length: jax.jvp(angles, (length,), (1.0,)))  # the angles and their slope
measured, _ = both(1.07)
length = 1.0
for _ in range(4):
    found, slope = both(length)
    length = length - slope @ (found - measured) / (slope @ slope)
    print(f"length {length:.9f} m")
