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
# from the same first weights: by SHAC, with gradients through short motions and a value function
# for the rest (`rb.envs.learning.shac`), and by an evolution strategy, which only uses the rewards
# of whole episodes. Which one needs fewer steps of the robot, and which one less time?

# %%
import time

import jax
import jax.flatten_util
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import rbjax as rb
from rbjax.plotting import STYLE, Camera, strobe

plt.rcParams.update(STYLE)
DT, EPISODE = 0.02, 250

# %% [markdown]
# ## The task
# The force is at most 10 N. The reward of a step depends on the angle, the position of the cart,
# the velocities and the force. Episodes begin at any angle; one that leaves the track ends.

# %%
model = rb.load("cart_pole")
model = model.replace(actuators=model.actuators.replace(ctrlrange=jnp.asarray([[-10.0, 10.0]])))


def swing_up(to):
    x, angle = to.before.q
    still = (to.before.v**2).sum()
    return 2 + jnp.cos(angle) - 0.1 * x**2 - 0.01 * still - 0.001 * (to.ctrl**2).sum()


def observe(to):
    (x, angle), v = to.after.q, to.after.v
    return jnp.stack([x, jnp.sin(angle), jnp.cos(angle), 0.5 * v[0], 0.3 * v[1]])


def anywhere(key, params):
    return start(key, [0.0, 0.0], [0.5, np.pi], 1.0)


def hanging(key, params):
    return start(key, [0.0, np.pi], [0.3, 0.5], 0.5)


def start(key, middle, width, fast):
    one, two = jax.random.split(key)
    q = jnp.asarray(middle) + jnp.asarray(width) * jax.random.uniform(one, (2,), minval=-1.0)
    return rb.State(q, fast * jax.random.uniform(two, (2,), minval=-1.0))


def environment(start, episode=EPISODE, **more):
    task = rb.envs.Task(
        "swing_up", model, start, {"policy": (rb.envs.Observation("state", observe),)},
        (rb.envs.Reward("swing_up", swing_up),), dt=DT, episode=episode,
        total_reward=lambda terms, dt: sum(terms.values()), **more,
    )  # fmt: skip
    return rb.envs.Environment(task)


env = environment(anywhere, terminations={"off": lambda to: jnp.abs(to.after.q[0]) > 3.0})
untrained = rb.envs.learning.new_policy(env, jax.random.key(0), (32, 16), std=None)

# %% [markdown]
# A policy is judged from 1,000 starts that it has not seen, all hanging within half a radian. One
# is solved if the pole is within 0.1 rad of upright during the whole of the last of six seconds,
# and the cart within half a metre of the middle.

# %%
SECONDS = 6.0
judge = environment(hanging, round(SECONDS / DT))


@jax.jit
def observations(policy):
    def one(key):
        obs, state = judge.reset(key)
        return judge.unroll(key, obs, state, policy, judge.episode)[2]["obs"]

    return jax.vmap(one)(jax.random.split(jax.random.key(1), 1000))


def solved(policy):
    last = observations(policy)[:, -50:]
    held = (last[..., 2] > np.cos(0.1)) & (jnp.abs(last[..., 0]) < 0.5)
    return np.asarray(held.all(1))


print(f"before training: {solved(untrained).mean():.1%} of the starts are solved")

# %% [markdown]
# ## Through the dynamics
# 128 robots in parallel, 32 steps an iteration: the gradient of the rewards of these steps, with
# the value of the last state. 300 iterations are 1.2 million steps.

# %%
BATCH, HORIZON, ITERATIONS = 128, 32, 300
begin = time.perf_counter()
trained = rb.envs.learning.shac(
    env, jax.random.key(0), untrained, iterations=ITERATIONS, batch=BATCH, horizon=HORIZON,
    rate=1.5e-2, critic_rate=2e-3, critic_steps=16,
)  # fmt: skip
seconds = time.perf_counter() - begin
steps = BATCH * HORIZON * np.arange(1, ITERATIONS + 1) / 1e6
by_gradients = solved(trained.policy).mean()
print(f"{steps[-1]:.2f} M steps, {seconds:.0f} s with compiling: {by_gradients:.1%} solved")

# %% [markdown]
# ## By an evolution strategy
# All weights are disturbed at random, up and down (Salimans et al. 2017). The mean of the
# disturbances, each weighted by the rank of its reward, is the direction of the step. It needs no
# derivative, and it uses whole episodes of five seconds. It may run as long.

# %%
PAIRS, EPISODES, SIGMA = 32, 4, 0.1
plain = untrained.replace(normaliser=None)
weights, shaped = jax.flatten_util.ravel_pytree(plain.network)
optimiser = optax.adam(0.03)


def of_weights(weights):
    return plain.replace(network=shaped(weights))


def episode_reward(weights, keys):
    def one(key):
        obs, state = env.reset(key)
        return env.unroll(key, obs, state, of_weights(weights), EPISODE)[2]["reward"].mean()

    return jax.vmap(one)(keys).mean()


@jax.jit
def turn(weights, memory, key):
    key, one, two = jax.random.split(key, 3)
    e = jax.random.normal(one, (PAIRS, weights.size))
    e = jnp.concatenate([e, -e])
    rewards = jax.vmap(episode_reward, (0, None))(
        weights + SIGMA * e, jax.random.split(two, EPISODES)
    )
    ranks = jnp.argsort(jnp.argsort(rewards)) / (2 * PAIRS - 1) - 0.5
    update, memory = optimiser.update(-(ranks[:, None] * e).mean(0) / SIGMA, memory)
    return optax.apply_updates(weights, update), memory, key, rewards.mean()


begin, carry, seen = time.perf_counter(), (weights, optimiser.init(weights), jax.random.key(0)), []
while time.perf_counter() - begin < seconds:
    *carry, mean = turn(*carry)
    seen.append((time.perf_counter() - begin, float(mean)))
sampled = of_weights(carry[0])
times, rewards = np.transpose(seen)
per_turn = 2 * PAIRS * EPISODES * EPISODE / 1e6
by_sampling = solved(sampled).mean()
print(f"{len(seen) * per_turn:.0f} M steps, {times[-1]:.0f} s: {by_sampling:.1%} solved")

# %% [markdown]
# ## Comparison
# The curves are the mean reward of a step in training. A gradient has more information on a small
# network than a sample: it needs a small share of the steps. A step of a cart-pole is so cheap that
# the samples catch up in time. The larger the robot and the network, the more this costs: noise
# grows with the number of weights, gradients do not. (On the right the time of the gradients,
# compiling included, is spread evenly over the iterations.)

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
taken = seconds * np.arange(1, ITERATIONS + 1) / ITERATIONS
axes[0].semilogx(steps, trained.rewards, label="SHAC")
axes[0].semilogx(per_turn * np.arange(1, len(seen) + 1), rewards, label="evolution strategy")
axes[0].set(xlabel="steps of a robot, million", ylabel="reward of a step")
axes[1].plot(taken, trained.rewards, label="SHAC")
axes[1].plot(times, rewards, label="evolution strategy")
axes[1].set(xlabel="seconds, with compiling")
axes[1].legend(loc="lower right")
figure.tight_layout()
plt.show()

# %% [markdown]
# Where each policy succeeds, by the first angle and its rate, and how one swing looks.

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
named = {"SHAC": trained.policy, "evolution strategy": sampled}
first = observations(untrained)[:, 0]
angle, rate = np.arctan2(first[:, 1], first[:, 2]) % (2 * np.pi), first[:, 4] / 0.3
for axis, (name, policy) in zip(axes, named.items(), strict=True):
    good = solved(policy)
    axis.plot(angle[good], rate[good], ".", color="tab:green", ms=3, label="solved")
    axis.plot(angle[~good], rate[~good], "x", color="tab:red", label="not")
    axis.set(title=f"{name}: {good.mean():.1%}", xlabel="first angle, rad")
axes[0].set(ylabel="rate, rad/s")
figure.tight_layout(rect=(0, 0, 0.9, 1))
axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=2)
plt.show()

# %%
path = np.asarray(observations(trained.policy)[0])
q = np.stack([path[:, 0], np.unwrap(np.arctan2(path[:, 1], path[:, 2]))], 1)
figure, axes = plt.subplots(2, 1, figsize=(8, 5.2), height_ratios=[2, 1])
strobe(model, q[:61:4], ax=axes[0], source="cart_pole", camera=Camera(-90, 5), shadow=False)
axes[0].set(title="the first 1.2 s of one swing")
axes[0].axis("off")
axes[1].plot(DT * np.arange(len(q)), q, label=["cart, m", "pole, rad"])
axes[1].set(xlabel="s")
axes[1].legend(loc="center right")
figure.tight_layout()
plt.show()
