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
# # A policy on a robot that differs from its model
#
# A policy that is trained in simulation meets a robot that has more friction, and a motor that acts
# late. It does badly there. Its own logs are enough to identify friction and delay, by derivatives
# of the simulation. The policy is then trained further in the corrected simulation, by gradients,
# from the end of PPO.
#
# The "robot" here is a second simulation, whose numbers the training does not know.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE

plt.rcParams.update(STYLE)
DT, EPISODE = 0.02, 250
learning = rb.envs.learning

# %% [markdown]
# ## The task
# A cart with a force of 10 N balances a pole near the middle of the rail, for five seconds. The
# episode ends if the pole is 0.8 rad from upright or the cart 2 m from the middle. Position and
# velocity are measured with noise. Damping of the cart and delay of the motor are arguments.


# %%
def task(damping, delay):
    model = rb.load("cart_pole")
    model = model.replace(
        actuators=model.actuators.replace(ctrlrange=jnp.array([[-10.0, 10.0]])),
        joints=model.joints.replace(damping=jnp.array([damping, 0.01])),
    )
    measured = jnp.array([0.002, 0.002, 0.02, 0.02])  # half-width of the noise, m, rad, m/s, rad/s
    return rb.envs.Task(
        "balance", model, start,
        {"policy": (rb.envs.Observation("state", state_of, noise=measured),)},
        (rb.envs.Reward("near_the_middle", near_the_middle),),
        action_delay=(delay, delay), dt=DT, episode=EPISODE,
        terminations={
            "fell": lambda to: jnp.abs(to.after.q[1]) > 0.8,
            "left": lambda to: jnp.abs(to.after.q[0]) > 2.0,
        },
        total_reward=lambda terms, dt: sum(terms.values()),
    )  # fmt: skip


def start(key, params):
    q, v = jax.random.uniform(key, (2, 2), minval=-1.0)
    return rb.State(jnp.array([0.5, 0.2]) * q, 0.3 * v)


def state_of(to):
    return jnp.concatenate([to.after.q, to.after.v])


def near_the_middle(to):
    x, angle = to.after.q
    return 1 - 0.2 * x**2 - 2 * angle**2 - 0.001 * to.ctrl[0] ** 2


nominal = rb.envs.Environment(task(damping=0.1, delay=0))
robot = rb.envs.Environment(task(damping=4.0, delay=4))


def judge(env, policy):
    """Return the mean return, and the share of the episodes that stay up to the end."""
    found = learning.evaluate(env, policy, jax.random.key(9), 500)
    return float(found.returns.mean()), float(1 - found.terminated.mean())


# %% [markdown]
# ## PPO in the nominal simulation

# %%
begin = time.perf_counter()
first = learning.ppo(
    nominal, jax.random.key(0), steps=400_000, num_envs=64, unroll_length=16, batch_size=64,
    num_minibatches=4, num_updates_per_batch=8, discounting=0.98, learning_rate=1e-3,
    entropy_cost=1e-3, policy_hidden=(32, 32), value_hidden=(64, 64), reports=4, evaluations=64,
)  # fmt: skip
print(f"PPO: {time.perf_counter() - begin:.0f} s, returns {np.round(first.rewards, 1)}")
for name, env in (("simulation", nominal), ("robot", robot)):
    total, up = judge(env, first.policy)
    print(f"{name:10}: return {total:6.1f}, up {up:.1%}")

# %% [markdown]
# ## Logs of the robot
# Four runs of two seconds, with the noise of the policy as excitation. A log has the measured
# states and the commands.

# %%
STEPS = 100


@jax.jit
@jax.vmap
def run(key):
    obs, state = robot.reset(key)
    return robot.unroll(key, obs, state, first.policy, STEPS)[2]


logs = run(jax.random.split(jax.random.key(5), 4))
states, commands = logs["obs"], logs["action"]  # (4, STEPS, 4), (4, STEPS, 1)

# %% [markdown]
# ## Identification
# The balanced pole is unstable, so that a simulation over a whole log depends on every error. The
# residual is therefore that of short windows of 0.2 s, each simulated from its first measured
# state, in units of the noise. The delay is a number of steps: for each candidate the damping is
# found by Gauss-Newton, with the exact derivative of the simulation.

# %%
WINDOW, CANDIDATES = 10, 9
firsts = np.arange(CANDIDATES, STEPS - WINDOW, 5)
noise = jnp.array([0.002, 0.002, 0.02, 0.02]) / np.sqrt(3)


def residual(damping, delay):
    model = nominal.task.model
    model = model.replace(joints=model.joints.replace(damping=jnp.array([damping, 0.01])))

    def window(states, commands, k):
        x = jax.lax.dynamic_slice_in_dim(states, k, WINDOW + 1)
        ctrl = jax.lax.dynamic_slice_in_dim(commands, k - delay, WINDOW)
        path = rb.rollout(model, rb.State(x[0, :2], x[0, 2:]), ctrl, DT)
        return (jnp.concatenate([path.q, path.v], 1)[1:] - x[1:]) / noise

    each = jax.vmap(jax.vmap(window, (None, None, 0)), (0, 0, None))
    alive = ~logs["done"].any(1)  # an episode that ended has another start
    return (each(states, commands, firsts) * alive[:, None, None, None]).reshape(-1)


@jax.jit
def fit(delay):
    damping = jnp.asarray(0.1)
    for _ in range(8):
        r, J = residual(damping, delay), jax.jacfwd(residual)(damping, delay)
        damping = damping - J @ r / (J @ J)
    return damping, (residual(damping, delay) ** 2).mean() ** 0.5


fits = [fit(delay) for delay in range(CANDIDATES)]
for delay, (damping, error) in enumerate(fits):
    print(
        f"delay {delay * DT:.2f} s: damping {damping:6.2f} N s/m, error {error:5.2f} of the noise"
    )
delay = int(np.argmin([error for _, error in fits]))
damping = float(fits[delay][0])
print(f"found {damping:.2f} N s/m and {delay * DT:.2f} s; the robot has 4 N s/m and 0.08 s")

# %% [markdown]
# ## Training by gradients, from the policy of PPO
# The corrected simulation has the damping and the delay that were found. The value function is
# new, so that it is trained for some iterations before the policy changes (`warm_up`). The policy
# keeps its network, and the statistics of its observations.

# %%
corrected = rb.envs.Environment(task(damping, delay))
begin = time.perf_counter()
second = learning.shac(
    corrected, jax.random.key(1), first.policy, iterations=200, warm_up=20, batch=64, horizon=32,
    rate=2e-3, discount=0.98,
)  # fmt: skip
print(f"SHAC: {time.perf_counter() - begin:.0f} s, {200 * 64 * 32 / 1e6:.2f} M steps")
for name, env in (("corrected simulation", corrected), ("robot", robot)):
    total, up = judge(env, second.policy)
    print(f"{name:20}: return {total:6.1f}, up {up:.1%}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4))
axes[0].plot(second.rewards)
axes[0].set(xlabel="iteration", ylabel="reward of a step", title="Training by gradients")


@jax.jit
def motion(policy):
    obs, state = robot.reset(jax.random.key(7))
    return robot.unroll(jax.random.key(7), obs, state, lambda o, key: policy(o), EPISODE)[2]


for name, policy in (("PPO", first.policy), ("after identification", second.policy)):
    path = motion(policy)
    ends = np.flatnonzero(path["done"])
    n = int(ends[0]) + 1 if len(ends) else EPISODE
    axes[1].plot(DT * np.arange(n), path["obs"][:n, 1], label=name)
axes[1].set(xlabel="s", ylabel="pole, rad", title="The robot")
axes[1].legend()
figure.tight_layout()
plt.show()
