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
# # Parking a car with a trailer
#
# Forwards a trailer follows. Backwards it folds: reversing with a trailer is unstable. But wheels
# that roll are reversible: the way out of a bay, run backwards in time, is a way into it. So the
# plan is the way out, forwards, and a regulator holds the rig on it while it drives in on tyres.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax import wheeled
from rbjax.planning import Footprint, OccupancyGrid
from rbjax.plotting import STYLE, top_view

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

rig = wheeled.kinds()["car_trailer"].make(motor=wheeled.SpeedServo(3000.0))
car = Footprint.rectangle(ahead=3.3, behind=0.7, width=1.8)
trailer = Footprint.rectangle(ahead=1.6, behind=1.2, width=1.7)

# %% [markdown]
# ## The yard
#
# A street between two walls, and a bay. A parked rig stands with its front to the street.

# %%
CELL = 0.2
x, y = np.meshgrid(np.arange(0, 36, CELL), np.arange(-10, 9, CELL), indexing="ij")
walls = (y > 8) | ((y < 0) & ((x < 10) | (x > 14))) | (y < -9.5)
grid = OccupancyGrid(walls, CELL, [0.0, -10.0])
parked = np.array([12.0, -3.6, np.pi / 2])
street = np.array([30.0, 4.5, 0.0])

# %% [markdown]
# ## The way out
#
# `plan` finds the car's path. Pure pursuit drives along it, forwards, and the trailer follows. The
# speed rises from zero and falls to zero.

# %%
plan = rb.planning.plan(grid, car, parked, street, radius=6.0, backwards=False)
way = plan.path.poses
length = float(plan.path.length)
print(plan.status, plan.refinement, f"{length:.1f} m")

# %%
DT, SECONDS = 0.02, 30.0
STEPS = round(SECONDS / DT)
out = wheeled.at(rig, "kinematic")
driven = 0.97 * length


def outwards(t, state):
    """Wheel speed and rate of steering."""
    speed = driven / SECONDS * (1 - jnp.cos(2 * jnp.pi * t / SECONDS))
    twist = wheeled.pure_pursuit(way, state.q[:3], 1.0, 2.0)
    wanted = wheeled.commands(rig, twist)
    angle = state.q[rig.layout.steerings.start]
    return jnp.stack([speed * wanted.speeds[0], 3.0 * speed * (wanted.angles[0] - angle)])


path = wheeled.rollout(out, wheeled.start(out, pose=parked), outwards, DT, steps=STEPS)

# %% [markdown]
# The plan knew nothing of the trailer. Did it stay clear of the walls, too?

# %%
field = grid.distance_field()


def pose_of_trailer(q):
    """By the coupling, which both bodies share."""
    hitch, bar = rig.bodies[1].hitch, rig.bodies[1].drawbar
    heading = q[2] + q[3]
    turn = jnp.array([[jnp.cos(q[2]), -jnp.sin(q[2])], [jnp.sin(q[2]), jnp.cos(q[2])]])
    place = q[:2] + turn @ hitch - bar * jnp.array([jnp.cos(heading), jnp.sin(heading)])
    return jnp.append(place, heading)


def least_clearance(path):
    trailers = jax.vmap(pose_of_trailer)(path.q)
    return [
        float(rb.planning.clearance(field, poses, shape).min())
        for poses, shape in ((path.q[:, :3], car), (trailers, trailer))
    ]


print("least clearance of car and trailer [m]:", np.round(least_clearance(path), 2))

# %% [markdown]
# ## The way in
#
# The same states backwards in time, with the opposite wheel speeds and rates of steering. The
# reference is for the robot with inertia, whose one free velocity is the car's speed.
# `tracking_gains` linearises every step of it and solves the Riccati recursion.

# %%
given = jax.vmap(outwards)(path.ts[:-1], rb.State(path.q[:-1], path.v[:-1]))
controls = -given[::-1]
rolling = wheeled.at(rig, "reduced")
wheel = float(rig.wheels[0].radius)
speeds = jnp.append(controls[:, 0] * wheel, 0.0)
reference = rb.State(path.q[::-1], speeds[:, None])
weights = jnp.concatenate(
    [jnp.array([1.0, 1.0, 10.0, 10.0, 1.0]), jnp.zeros(rolling.nq - 5), jnp.array([0.1])]
)
gains = wheeled.tracking_gains(rolling, reference, controls, DT, weights, jnp.array([0.1, 1.0]))

# %% [markdown]
# Now on tyres that slip, from a start that is 20 cm and 3 degrees off. Without the regulator the
# rig folds; with it, it parks. At such low speeds the contacts of light wheels are stiff: the
# linearly implicit method takes them as dampers, with the steps of the regulator.

# %%
slipping = wheeled.at(rig, "slipping", tyre=wheeled.Fiala(15.0, 0.8, smooth_speed=0.1))
start = wheeled.start(slipping)
start = start.replace(q=reference.q[0].at[1].add(0.2).at[2].add(0.05))


def regulated(strength):
    def control(t, state):
        k = jnp.clip(jnp.round(t / DT).astype(int), 0, STEPS - 1)
        off = jnp.concatenate([state.q - reference.q[k], state.v[:1] - reference.v[k]])
        off = off.at[rig.layout.shafts].set(0.0)  # the angles of wheels do not matter
        u = controls[k] - strength * gains[k] @ off
        return jnp.stack([u[0], jnp.clip(u[1], -0.6, 0.6)])

    return control


figure, axes = plt.subplots(1, 2, figsize=(12, 4), sharex=True, sharey=True)
for ax, (name, strength) in zip(axes, {"open loop": 0.0, "regulated": 1.0}.items(), strict=True):
    found = wheeled.rollout(
        slipping, start, regulated(strength), DT, steps=STEPS, save_every=10,
        integrator="linearly_implicit_euler",
    )  # fmt: skip
    ax.plot(*reference.q[:, :2].T, "--", color="gray", lw=1)
    top_view(slipping, found, ax=ax, robots=7, grid=grid)
    ax.set_title(name)
    end = np.asarray(found.q[-1])
    print(
        f"{name}: the car ends {np.hypot(*(end[:2] - parked[:2])):.2f} m off, the trailer at "
        f"{np.degrees(end[3]):.1f} degrees; least clearance {np.round(least_clearance(found), 2)} m"
    )
plt.show()
