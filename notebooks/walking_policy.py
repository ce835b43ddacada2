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
# # A policy that walks
#
# A Unitree Go1 learns to follow velocity commands in less than two minutes on a GPU. This notebook
# looks at the task, runs the saved policy on a CPU, shows the curves of the trainings, trains two
# policies for a cart-pole here, and runs the Go1 policy in the physics of MuJoCo.
#
# It reads files of the repository: `notebooks/data` and `benchmarks/results`.

# %%
import dataclasses
import json
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from IPython.display import Image

import rbjax as rb
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, STYLE

plt.rcParams.update(STYLE)
learning = rb.envs.learning
REPOSITORY = Path(rb.__file__).parents[1]
FOLDER = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The task
# A task is a robot with observations, rewards and ends of episodes, each a small function with a
# name. The reward of a step is the control step times the weighted sum of the terms, at least 0.
# The group "policy" of the observations has noise and is what the policy reads. The group "critic"
# has in addition what the robot cannot measure. Only the value function reads it, in training.

# %%
env = rb.envs.make("go1_joystick_flat")
task = env.task
print(f"control step {env.dt:.2f} s, of {task.decimation} physics steps; {env.episode} an episode")
print(f"{env.action_size} actions, observations {env.observation_size}")
print("observed:", ", ".join(o.name for o in task.observations["policy"]))
print("episode ends:", ", ".join(task.terminations))
for reward in task.rewards:
    print(f"{reward.weight:8g}  {reward.name}")

# %% [markdown]
# ## A trained policy walks
# The checkpoint was written on an H100 after 112 s of PPO, with compiling. Its parameters are plain
# arrays, so that a CPU reads them too. The picture has random commands of the task, and the contact
# forces in red.

# %%
env, policy = learning.load_policy(REPOSITORY / "notebooks" / "data" / "go1_policy")
film = rb.plotting.animate_policy(
    env,
    policy,
    FOLDER / "walk.gif",
    seconds=4.0,
    fps=12.5,
    size=(320, 240),
    title="Go1",
    progress=lambda done, total: None,
)
Image(film.read_bytes(), format="gif")

# %% [markdown]
# Now the commands are given: stand, walk forwards, sideways, and in a circle. A command is a
# variable of the task, so that a program or a joystick can set it before each step. A further group
# of observations, without noise, is what the plots show.

# %%
COMMANDS = {
    "stand": (0.0, 0.0, 0.0),
    "forwards": (1.0, 0.0, 0.0),
    "sideways": (0.0, 0.5, 0.0),
    "circle": (0.6, 0.0, 1.0),
}  # m/s, m/s, rad/s
EACH = 125  # control steps
commands = np.repeat(list(COMMANDS.values()), EACH, axis=0).astype(np.float32)
watched = (
    rb.envs.Observation("velocity", rb.sensors.Velocimeter("imu")),
    rb.envs.Observation("rate", rb.sensors.Gyro("imu")),
    rb.envs.Observation("contact", lambda to: to.variables["last_contact"]),
)
observed = rb.envs.Environment(
    dataclasses.replace(task, observations={**task.observations, "watched": watched})
)


@jax.jit
def walk(key):
    def step(carry, now):
        (obs, state), (key, command) = carry, now
        given = {"command": command, "command_steps": jnp.asarray(1e6)}  # no random command
        state = state.replace(variables=state.variables | given)
        obs, state, _, done, _ = observed.step_once(key, state, policy(obs))
        return (obs, state), (obs["watched"], done)

    keys = jax.random.split(key, len(commands))
    return jax.lax.scan(step, observed.reset(key), (keys, commands))[1]


seen, done = map(np.asarray, walk(jax.random.key(0)))
speed, contact = seen[:, [0, 1, 5]], seen[:, 6:] > 0
print("fell" if done.any() else "did not fall")
print("mean over the second half of each command, m/s, m/s, rad/s:")
for k, (name, command) in enumerate(COMMANDS.items()):
    mean = speed[k * EACH + EACH // 2 : (k + 1) * EACH].mean(0)
    print(f"{name:9} command {command}, robot", *(f"{x:6.2f}" for x in mean))

# %% [markdown]
# The robot trots: feet that are diagonally opposite touch together. The policy found this gait;
# no reward term names one. If the command is zero, it stands still on four feet.

# %%
t = env.dt * np.arange(1, len(commands) + 1)
figure, axes = plt.subplots(4, 1, figsize=(10, 7), sharex=True, layout="constrained")
labels = ("forwards, m/s", "to the left, m/s", "yaw rate, rad/s")
for axis, v, c, label in zip(axes, speed.T, commands.T, labels, strict=False):
    axis.plot(t, v, color=BLUE, lw=1, label="robot")
    axis.plot(t, c, color=INK, ls="--", lw=1.2, label="command")
    axis.set(ylabel=label)
axes[0].legend(loc="upper right")
FEET = ("front right", "front left", "rear right", "rear left")
COLORS = (ORANGE, GREEN, GREEN, ORANGE)  # one colour for a diagonal pair
for k, color in enumerate(COLORS):
    axes[3].fill_between(t, k - 0.35, k + 0.35, where=contact[:, k], color=color, step="pre", lw=0)
axes[3].set(yticks=range(4), yticklabels=FEET, xlabel="s", title="feet in contact")
for k, name in enumerate(COMMANDS):
    axes[0].text((k + 0.5) * EACH * env.dt, 1.45, name, ha="center")
axes[0].set(ylim=(-0.6, 1.7))
plt.show()

# %%
trot = slice(EACH + EACH // 2, 2 * EACH)  # the second half of "forwards"
same = (contact[trot, 0] == contact[trot, 3]) & (contact[trot, 1] == contact[trot, 2])
landings = (contact[trot][1:] & ~contact[trot][:-1]).sum(0)
print(f"both diagonal pairs agree in {same.mean():.0%} of the steps")
print(f"a foot touches for {contact[trot].mean():.0%} of the time")
print(f"it lands {landings.mean() / (env.dt * EACH / 2):.1f} times a second")

# %% [markdown]
# ## The curves of the trainings
# Reward of an episode against time on one H100, with compiling. The command of each is
# `python -m benchmarks.envs.training --task TASK --algorithm ppo` (or `shac`). Go1 stops after
# `--steps 100000000`. G1 has at most three Newton steps in a contact problem
# (`--option iterations=3`).

# %%
CURVES = (
    (0, "Go1, PPO", "go1-joystick-flat-ppo"),
    (0, "G1, PPO", "g1-joystick-ppo"),
    (1, "PPO", "panda-pick-cube-ppo"),
    (2, "PPO", "cart-pole-swing-up-ppo"),
    (2, "SHAC", "cart-pole-swing-up-shac"),
)
TITLES = ("follow velocity commands", "Panda brings a cube to a place", "cart-pole swings up")
figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for place, name, stem in CURVES:
    file = f"training-{stem}-nvidia-h100-80gb-hbm3.json"
    (row,) = json.loads((REPOSITORY / "benchmarks" / "results" / file).read_text())["rows"]
    curve = np.array([(p["seconds"], p["reward"]) for p in row["curve"]], float)
    curve = curve[np.isfinite(curve[:, 1])]
    axes[place].plot(*curve.T, marker="o", ms=3, label=name)
    seconds, reward, millions = *curve[-1], row["steps"] / 1e6
    print(f"{stem:25} {reward:7.1f} after {seconds:5.1f} s, {millions:.1f} M steps")
for axis, title in zip(axes, TITLES, strict=True):
    axis.set(xlabel="s on a GPU", xlim=(0, None), title=title)
    axis.legend(loc="lower right")
axes[0].set(ylabel="reward of an episode")
plt.show()

# %% [markdown]
# ## Training on a CPU
# The same call trains small tasks on a CPU. PPO balances a pole; SHAC, which differentiates through
# the simulation, swings it up. Both rewards are between 0 and 1 in each of 1,000 steps.

# %%
TRAININGS = {
    "cart_pole_balance": ("ppo", {"reports": 10}),
    "cart_pole_swing_up": ("shac", {"steps": 600_000}),
}
figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
for name, (algorithm, changes) in TRAININGS.items():
    begin, out = time.perf_counter(), FOLDER / name
    trained = learning.train(name, algorithm, out=out, progress=False, **changes)
    seconds = time.perf_counter() - begin
    table = np.genfromtxt(out / "table.csv", delimiter=",", names=True)
    known = np.isfinite(table["reward"])
    axis.plot(table["seconds"][known], table["reward"][known], marker="o", ms=3,
              label=f"{name}, {algorithm.upper()}")  # fmt: skip
    found = learning.evaluate(rb.envs.make(name), trained.policy, jax.random.key(1), 64)
    print(
        f"{name}: {table['steps'][-1] / 1e6:.2f} M steps in {seconds:.0f} s with compiling, "
        f"reward {found.returns.mean():.0f} over 64 new episodes"
    )
axis.set(xlabel="s on a CPU, with compiling", ylabel="reward of an episode", xlim=(0, None))
axis.set(ylim=(0, 1050))
axis.legend(loc="upper left")
plt.show()

# %% [markdown]
# ## The same policy in MuJoCo
# A policy that works only in the simulator of its training is of little use.
# `rb.validation.evaluate_in_mujoco` runs the task with the physics of MuJoCo C, from the same file
# and with its solver settings. Without noise and with constant commands the only difference
# is the physics, so that the returns of each robot can be compared one by one. Twelve robots walk
# for 200 steps.

# %%
calm = dataclasses.replace(
    task, episode=200, values={**task.values, "command_time": 1e6},
    observations={
        group: tuple(dataclasses.replace(o, noise=0.0) for o in terms)
        for group, terms in task.observations.items()
    },
)  # fmt: skip
short, key = rb.envs.Environment(calm), jax.random.key(3)
file = Path(rb.envs.__file__).parent / "robots" / "go1.xml"
here = learning.evaluate(short, policy, key, 12)
there = rb.validation.evaluate_in_mujoco(
    short, policy, mujoco.MjModel.from_xml_path(str(file)), key, 12
)
for name, found in (("rbjax", here), ("MuJoCo", there)):
    up = 1 - found.terminated.mean()
    print(f"{name:7} return {found.returns.mean():.3f}, upright to the end {up:.0%}")
print(f"largest difference of a robot: {jnp.abs(here.returns - there.returns).max():.3f}")

# %%
figure, axis = plt.subplots(figsize=(4, 3.6), layout="constrained")
low, high = (float(f(jnp.stack([here.returns, there.returns]))) for f in (jnp.min, jnp.max))
axis.plot([low, high], [low, high], color=INK, lw=0.8, ls="--")
axis.plot(here.returns, there.returns, "o", color=ORANGE, ms=5)
axis.set(xlabel="return in rbjax", ylabel="return in MuJoCo C", title="each robot, 4 s")
axis.set_aspect("equal")
plt.show()
