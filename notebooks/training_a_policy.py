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
# # A policy, by gradients and by sampling
#
# A small network shall swing a cart-pole up from anywhere and keep it there. It is trained twice,
# from the same first weights: through the dynamics, by gradients of short motions with a value
# function for the rest (`rb.control.actor_critic`), and by an evolution strategy, which only sees
# what whole episodes cost. Which one needs fewer steps of the robot, and which one less time?

# %%
import time

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import rbjax as rb
from rbjax.plotting import Camera, strobe

plt.rcParams.update({"figure.dpi": 110, "axes.grid": True, "grid.alpha": 0.3})
DT, EPISODE = 0.02, 250

# %% [markdown]
# ## The task
# The force is at most 10 N. A state costs by the angle, the place of the cart, the velocities and
# the force. Motions begin at any angle; one that leaves the track is lost and starts again.

# %%
model = rb.load("cart_pole")
model = model.replace(actuators=model.actuators.replace(ctrlrange=jnp.asarray([[-10.0, 10.0]])))


def cost(state, ctrl):
    x, angle = state.q
    return 1 - jnp.cos(angle) + 0.1 * x**2 + 0.01 * (state.v**2).sum() + 0.001 * (ctrl**2).sum()


def observe(state):
    x, angle = state.q
    return jnp.stack([x, jnp.sin(angle), jnp.cos(angle), 0.5 * state.v[0], 0.3 * state.v[1]])


def start(key):
    one, two = jax.random.split(key)
    wide = jnp.asarray([0.5, jnp.pi])
    q = jax.random.uniform(one, (2,), minval=-wide, maxval=wide)
    return rb.State(q, jax.random.uniform(two, (2,), minval=-1.0, maxval=1.0))


env = rb.control.Environment(
    model, cost, start, dt=DT, observe=observe, episode=EPISODE,
    lost=lambda state: jnp.abs(state.q[0]) > 3.0,
)  # fmt: skip
untrained = rb.control.network(jax.random.key(0), (5, 32, 16, 1))

# %% [markdown]
# A policy is judged from 1,000 starts that it has not seen, all hanging within half a radian. One
# is solved where the pole is within 0.1 rad of upright during the whole of the last of six seconds,
# and the cart within half a metre of the middle.

# %%
rng = np.random.default_rng(1)
hanging = rb.State(
    jnp.asarray(np.stack([rng.uniform(-0.3, 0.3, 1000), np.pi + rng.uniform(-0.5, 0.5, 1000)], 1)),
    jnp.asarray(rng.uniform(-0.5, 0.5, (1000, 2))),
)


def motions(policy):
    return rb.rollout(model, hanging, env.controller(policy), DT, steps=300).q


def solved(policy):
    last = motions(policy)[:, -50:]
    held = (jnp.cos(last[..., 1]) > np.cos(0.1)) & (jnp.abs(last[..., 0]) < 0.5)
    return np.asarray(held.all(1))


print(f"before training: {solved(untrained).mean():.1%} of the starts are solved")

# %% [markdown]
# ## Through the dynamics
# 64 robots side by side, 32 steps an iteration: the gradient of what these steps cost, with the
# value of where they end. 300 iterations are 0.6 million steps.

# %%
BATCH, HORIZON, ITERATIONS = 64, 32, 300
begin = time.perf_counter()
trained = rb.control.actor_critic(
    env, untrained, jax.random.key(0), iterations=ITERATIONS, batch=BATCH, horizon=HORIZON,
    rate=1.5e-2, value_rate=2e-3, value_steps=16,
)  # fmt: skip
jax.block_until_ready(trained.costs)
seconds = time.perf_counter() - begin
steps = BATCH * HORIZON * np.arange(1, ITERATIONS + 1) / 1e6
by_gradients = solved(trained.policy).mean()
print(f"{steps[-1]:.2f} M steps, {seconds:.0f} s with compiling: {by_gradients:.1%} solved")

# %% [markdown]
# ## By an evolution strategy
# All weights are disturbed at random, up and down (Salimans et al. 2017). The mean of the
# disturbances, each weighed by the rank of what its episodes cost, is the direction of the step.
# It needs no derivative, and it sees whole episodes of five seconds. It may run as long.

# %%
PAIRS, EPISODES, SIGMA = 32, 4, 0.1
numbers, rest = eqx.partition(untrained, eqx.is_inexact_array)
weights, shaped = jax.flatten_util.ravel_pytree(numbers)
optimiser = optax.adam(0.03)


def of_weights(weights):
    return eqx.combine(shaped(weights), rest)


def episode_cost(weights, states):
    costs = env.unroll(of_weights(weights), None, states, EPISODE).costs
    return jnp.where(jnp.isfinite(costs), jnp.minimum(costs, 100.0), 100.0).mean()


@jax.jit
def turn(weights, memory, key):
    key, one, two = jax.random.split(key, 3)
    e = jax.random.normal(one, (PAIRS, weights.size))
    e = jnp.concatenate([e, -e])
    _, states = jax.vmap(env.reset)(jax.random.split(two, EPISODES))
    costs = jax.vmap(episode_cost, (0, None))(weights + SIGMA * e, states)
    ranks = jnp.argsort(jnp.argsort(costs)) / (2 * PAIRS - 1) - 0.5
    update, memory = optimiser.update((ranks[:, None] * e).mean(0) / SIGMA, memory)
    return optax.apply_updates(weights, update), memory, key, costs.mean()


begin, carry, seen = time.perf_counter(), (weights, optimiser.init(weights), jax.random.key(0)), []
while time.perf_counter() - begin < seconds:
    *carry, mean = turn(*carry)
    seen.append((time.perf_counter() - begin, float(mean)))
sampled = of_weights(carry[0])
times, costs = np.transpose(seen)
per_turn = 2 * PAIRS * EPISODES * EPISODE / 1e6
by_sampling = solved(sampled).mean()
print(f"{len(seen) * per_turn:.0f} M steps, {times[-1]:.0f} s: {by_sampling:.1%} solved")

# %% [markdown]
# ## Side by side
# The curves are what a step costs in the mean of the batch in training. Gradients tell a small
# network more in a step than samples do: they need a hundredth of the steps. A step of a cart-pole
# costs so little that the samples catch up in time. The larger the robot and the network, the
# dearer this becomes: noise grows with the number of weights, gradients do not. (On the right the
# time of the gradients, compiling included, is spread evenly over the iterations.)

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
taken = seconds * np.arange(1, ITERATIONS + 1) / ITERATIONS
axes[0].semilogx(steps, trained.costs, label="gradients")
axes[0].semilogx(per_turn * np.arange(1, len(seen) + 1), costs, label="evolution strategy")
axes[0].set(xlabel="steps of a robot, million", ylabel="cost of a step")
axes[1].plot(taken, trained.costs, label="gradients")
axes[1].plot(times, costs, label="evolution strategy")
axes[1].set(xlabel="seconds, with compiling", ylim=(0, 3))
axes[1].legend(loc="center right")
figure.tight_layout()
plt.show()

# %% [markdown]
# Where each policy succeeds, by the first angle and its rate, and how one swing looks.

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
named = {"gradients": trained.policy, "evolution strategy": sampled}
for axis, (name, policy) in zip(axes, named.items(), strict=True):
    good = solved(policy)
    angle, rate = np.asarray(hanging.q[:, 1]), np.asarray(hanging.v[:, 1])
    axis.plot(angle[good], rate[good], ".", color="tab:green", ms=3, label="solved")
    axis.plot(angle[~good], rate[~good], "x", color="tab:red", label="not")
    axis.set(title=f"{name}: {good.mean():.1%}", xlabel="first angle, rad")
axes[0].set(ylabel="rate, rad/s")
axes[1].legend(loc="upper right")
figure.tight_layout()
plt.show()

# %%
q = motions(trained.policy)[0]
figure, axes = plt.subplots(2, 1, figsize=(8, 5.2), height_ratios=[2, 1])
strobe(axes[0], "cart_pole", model, q[:61:4], camera=Camera(-90, 5), shadow=False)
axes[0].set(title="the first 1.2 s of one swing")
axes[0].axis("off")
axes[1].plot(DT * np.arange(len(q)), q, label=["cart, m", "pole, rad"])
axes[1].set(xlabel="s")
axes[1].legend(loc="center right")
figure.tight_layout()
plt.show()
