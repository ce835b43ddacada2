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
# # Racing a car
#
# A car on tyres drives round a track as fast as it can, by model predictive control: at every tick
# it plans the next two seconds, takes the first control, and plans again. Three planners drive the
# same car. One knows that tyres slip. One believes that wheels roll. The third believes so too, but
# plans with 70 % of the friction, and wants less speed.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax import control, wheeled
from rbjax.plotting import STYLE

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

FRICTION, WHEELBASE, RADIUS_OF_WHEEL, REAR_LOAD = 0.9, 2.6, 0.3, 6200.0  # load in N
robot = wheeled.kinds()["bicycle"].make(wheelbase=WHEELBASE, radius=RADIUS_OF_WHEEL, lag=0.1)
tyre = wheeled.Fiala(15.0, FRICTION, smooth_speed=0.5)
car = wheeled.at(robot, "slipping", tyre=tyre)
rolling = wheeled.at(robot, "reduced")

# %% [markdown]
# ## The track
#
# Its middle is a curve R(angle) about the origin, so how far the car is off the middle, and how
# fast it goes round, are closed forms of its state. Both are costs as they stand.

# %%
HALF_WIDTH, RADIUS = 4.0, 30.0


def middle(angle):
    """R and dR/d angle."""
    return RADIUS + 6 * jnp.cos(3 * angle), -18 * jnp.sin(3 * angle)


def offset(q):
    """m to the outside of the middle."""
    R, slope = middle(jnp.arctan2(q[1], q[0]))
    return (jnp.hypot(q[0], q[1]) - R) / jnp.sqrt(1 + (slope / R) ** 2)


def round_speed(model, state):
    """RADIUS times the rate of the angle about the origin, m/s."""
    x, y, heading = state.q[:3]
    along, across = state.v[0], (state.v[1] if model.name == "slipping" else 0.0)
    vx = along * jnp.cos(heading) - across * jnp.sin(heading)
    vy = along * jnp.sin(heading) + across * jnp.cos(heading)
    return RADIUS * (x * vy - y * vx) / (x * x + y * y)


# %% [markdown]
# ## One problem, two fidelities
#
# A cost is a function of the state, so the same costs serve both fidelities. Fast: the round speed
# should be 25 m/s, which it never is. On the track: the part of the offset beyond 3 m costs. The
# bounds are the limits of motor and steering. With steps of 0.05 s slip is stiff, so
# `linearly_implicit_euler` takes it at the end of each step.

# %%
TICK, HORIZON = 0.05, 40
MOST = jnp.array([1500.0, 0.5])


def fast(wanted):
    return lambda model, t, state, ctrl: round_speed(model, state)[None] - wanted


def on_track(t, state, ctrl):
    return jnp.maximum(jnp.abs(offset(state.q)) - (HALF_WIDTH - 1), 0.0)[None]


def gentle(t, state, ctrl):
    return ctrl / MOST


def grip(t, state, ctrl):
    """The part of the ellipse of friction, by wheels that roll, that is above 70 % of the limit."""
    ahead = ctrl[0] / (RADIUS_OF_WHEEL * FRICTION * REAR_LOAD)
    side = state.v[0] ** 2 * jnp.tan(state.q[3]) / (WHEELBASE * FRICTION * 9.81)
    return jnp.maximum(jnp.sqrt(ahead**2 + side**2 + 1e-9) - 0.7, 0.0)[None]


def planner(vehicle, wanted, *more):
    problem = control.Problem(
        wheeled.controlled(vehicle, integrator="linearly_implicit_euler", parts=4), HORIZON, TICK,
        running=[
            control.Cost(fast(wanted)), control.Cost(on_track, 300.0), control.Cost(gentle, 5.0),
            *more,
        ],
        terminal=[control.Cost(on_track, 300.0)], bounds=(-MOST, MOST),
    )  # fmt: skip
    return control.mpc(problem, iterations=3, delay=0)


# %% [markdown]
# ## The drive
#
# The plant is the car on tyres, with steps four times as fine. All planners see its coordinates;
# those without slip see its speed ahead.

# %%
SECONDS = 20.0
TICKS = round(SECONDS / TICK)
world = wheeled.controlled(car, integrator="linearly_implicit_euler", parts=16)
start = wheeled.start(car, pose=[36.0, 0.0, np.pi / 2], twist=[8.0, 0.0, 0.0])


def drive(name, vehicle, wanted, *more):
    """States and controls of all ticks, and the number of ticks until it is off the track."""
    controller = planner(vehicle, wanted, *more)

    def seen(state):
        return state if vehicle is car else rb.State(state.q, state.v[:1])

    def tick(carry, k):
        memory, state = carry
        ctrl, memory, _ = controller.tick(memory, k * TICK, seen(state))
        return (memory, world.step(0.0, state, ctrl, TICK)), (state, ctrl)

    def run(state):
        memory = controller.begin(seen(state))
        return jax.lax.scan(tick, (memory, state), jnp.arange(TICKS))[1]

    run = jax.jit(run).lower(start).compile()
    begin = time.process_time()
    states, ctrls = jax.block_until_ready(run(start))
    spent = 1e3 * (time.process_time() - begin) / TICKS
    off = np.abs(jax.vmap(offset)(states.q))
    ticks = int(np.argmax(off > HALF_WIDTH)) if (off > HALF_WIDTH).any() else TICKS
    turned = np.unwrap(np.arctan2(states.q[:ticks, 1], states.q[:ticks, 0])) / (2 * np.pi)
    if ticks < TICKS:
        how = f"off the track after {ticks * TICK:.1f} s, at {100 * turned[-1]:.0f} % of the lap"
    else:
        lap = np.interp(1.0, turned, np.arange(TICKS) * TICK, right=np.nan)
        how = f"a lap in {lap:.1f} s, at most {off.max():.1f} m off the middle"
    print(f"{name}: {how}; {spent:.1f} ms of CPU a tick")
    return states, ctrls, ticks


given = {
    "knows slip": (car, 25.0),
    "rolls": (rolling, 25.0),
    "rolls, held back": (rolling, 12.0, control.Cost(grip, 1e4)),
}
runs = {name: drive(name, *how) for name, how in given.items()}

# %% [markdown]
# On the left is where each went, up to where it left the track. Who believes in rolling enters the
# corner at the upper left too fast: the front tyre gives no more, and no plan says so. Held back it
# stays on the track and needs a quarter more time; wanting 15 m/s it leaves the track, too.
#
# On the right: the speed, and how much of the friction the front tyre takes, |force| / (friction x
# load), where 1 is full sliding. The planner that knows slip uses all of it in corners.

# %%
angles = np.linspace(0, 2 * np.pi, 721)
R, slope = (np.asarray(x) for x in middle(angles))
center = np.stack([R * np.cos(angles), R * np.sin(angles)])
normal = np.stack([R * np.cos(angles) + slope * np.sin(angles),
                   R * np.sin(angles) - slope * np.cos(angles)])  # fmt: skip
normal /= np.hypot(*normal)

figure, axes = plt.subplot_mosaic(
    [["track", "speed"], ["track", "grip"]], figsize=(12, 5.5), layout="constrained",
    width_ratios=[1, 1.2],
)  # fmt: skip
for side in (-HALF_WIDTH, HALF_WIDTH):
    axes["track"].plot(*(center + side * normal), color="gray", lw=1)
for name, (states, ctrls, ticks) in runs.items():
    q, v = np.asarray(states.q)[:ticks], np.asarray(states.v)[:ticks]
    touch = jax.vmap(lambda x, u: wheeled.contacts(car, x, u))(states, ctrls)
    used = np.hypot(*np.asarray(touch.forces)[:ticks, 1].T)
    used = used / (FRICTION * np.asarray(touch.loads)[:ticks, 1])
    ts = np.arange(ticks) * TICK
    axes["track"].plot(q[:, 0], q[:, 1], label=name)
    axes["speed"].plot(ts, v[:, 0])
    axes["grip"].plot(ts, used)
axes["track"].set(aspect="equal", xlabel="x, m", ylabel="y, m")
axes["track"].legend(frameon=False, loc="center")
axes["speed"].set(ylabel="speed, m/s")
axes["grip"].set(xlabel="t, s", ylabel="friction used, front")
plt.show()
