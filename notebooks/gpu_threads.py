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
# # A function of one robot as one GPU thread
#
# `rb.threads(f)` runs a batch of f as one kernel on a GPU. On other machines it is f itself, so
# this notebook runs anywhere. `docs/develop/threads.md` has measurements.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax.plotting import STYLE

plt.rcParams.update(STYLE)
model = rb.load("arm7")


# %% [markdown]
# ## Your own cost
#
# The function takes one sample. It may call any algorithm of rbjax, and close over arrays.


# %%
def effort(q, v, tau):
    a = rb.forward_dynamics(model, q, v, tau)
    return (a * a).sum() + (tau * tau).sum()


cost = rb.threads(effort)
keys = jax.random.split(jax.random.key(0), 64)
states = jax.vmap(model.random_state)(keys)
tau = jnp.zeros((64, model.nv))
total = jax.jit(jax.vmap(cost))(states.q, states.v, tau)
total.shape

# %% [markdown]
# Its derivatives are kernels too.

# %%
slope = jax.jit(jax.vmap(jax.grad(cost, 2)))(states.q, states.v, tau)
slope.shape

# %% [markdown]
# ## The thread
#
# `explain` counts the statements of the thread and the bytes that it reads and writes. On a GPU
# it also prints registers, local memory, the rate, and the shares of the device's limits.

# %%
print(rb.compiler.explain(effort, states.q[0], states.v[0], tau[0]))

# %% [markdown]
# Instruction fetches limit long programs: beyond about 8,000 statements a GPU runs each of them
# several times slower. So the driver matters: unrolled, rolled into a loop over the links, or by
# limbs (equal subtrees as a loop over one of them).

# %%
QUADRUPED = """
<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody><body><freejoint/>
<geom type="box" size=".3 .15 .05"/>
{legs}
</body></worldbody></mujoco>
"""
LEG = """
<body pos="{x} {y} 0"><joint axis="1 0 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 {s} 0"/>
  <body pos="0 {s} 0"><joint axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/>
    <body pos="0 0 -.2"><joint axis="0 1 0"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/></body></body></body>
"""
legs = "".join(LEG.format(x=x, y=y, s=y / 3) for x in (0.25, -0.25) for y in (0.15, -0.15))
quadruped = rb.load(QUADRUPED.format(legs=legs))
state = quadruped.random_state(jax.random.key(1))

counts = {}
for driver in ("unrolled", "limbs", "rolled"):
    robot = quadruped.replace(driver=driver)
    found = rb.compiler.explain(
        lambda q, v, robot=robot: rb.forward_dynamics(robot, q, v, 0 * v), state.q, state.v
    )
    counts[driver] = (found.statements, found.operations, found.array_bytes)

fig, axes = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained")
titles = ("statements in the code", "operations run", "bytes of local arrays")
for axis, title, values in zip(axes, titles, zip(*counts.values(), strict=True), strict=True):
    axis.bar(list(counts), values, color=["#4477aa", "#228833", "#ccbb44"])
    axis.set_title(title, fontsize=10)
plt.show()

# %% [markdown]
# ## Rollouts
#
# `rollout` runs all steps of a sample in its thread. The reverse gradient stores as many states as
# `memory` allows. A small policy is part of the thread; a network runs between the steps.


# %%
def act(weights):
    return lambda t, state: weights @ jnp.tanh(state.v)


def loss(weights):
    path = rb.rollout(model, states, act(weights), 0.01, steps=20, save_every=20, memory=2**28)
    return (path.v[:, -1] ** 2).mean()


weights = jnp.zeros((model.nu, model.nv))
value, gradient = jax.jit(jax.value_and_grad(loss))(weights)
float(value), gradient.shape
