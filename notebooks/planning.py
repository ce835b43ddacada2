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
# # Planning in the plane
#
# `rb.planning` has the shortest curves of a car, maps of obstacles, and a search among them. A pose
# is (x, y, heading), in m and rad.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.planning import Controls, Footprint, OccupancyGrid
from rbjax.plotting import STYLE

plt.rcParams.update(STYLE)

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Shortest curves
#
# A car that cannot turn more sharply than a circle of 1 m wants to stand 0.8 m further left, as it
# stands now. Forwards only (Dubins) it drives a loop; in both directions (Reeds and Shepp) it
# shuffles.

# %%
start, goal = jnp.zeros(3), jnp.array([0.0, 0.8, 0.0])
curves = {"dubins": rb.planning.dubins, "reeds_shepp": rb.planning.reeds_shepp}
figure, ax = plt.subplots(figsize=(6, 3.5))
for name, f in curves.items():
    curve = f(start, goal, 1.0)
    ax.plot(*curve.sample_poses(200)[:, :2].T, label=f"{name}: {curve.word}, {curve.length:.2f} m")
ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
_ = ax.legend(bbox_to_anchor=(1.05, 1.0), loc="upper left")

# %% [markdown]
# Both take batches of poses, and their lengths have gradients: which way should the goal move to
# shorten the curve?

# %%
goals = jnp.array([[2.0, y, 0.5] for y in (-1.0, 0.0, 1.0)])


def length(goal):
    return rb.planning.reeds_shepp(start, goal, 1.0).length


length(goals), jax.vmap(jax.grad(length))(goals)

# %% [markdown]
# ## Maps
#
# Cells of 5 cm: a wall with a door. The distance field is exact; the car is covered by discs, so
# that a test of a pose is one look into the field for each disc. `clearance` interpolates and can
# be differentiated; `clear` errs on the safe side.

# %%
walls = np.zeros((100, 80), bool)
walls[48:52] = True
walls[48:52, 50:66] = False
grid = OccupancyGrid(walls, 0.05)
car = Footprint.rectangle(ahead=0.5, behind=0.2, width=0.35)
field = grid.distance_field()
poses = jnp.array([[1.0, 1.0, 0.0], [2.3, 1.0, 0.0], [2.3, 2.9, 0.0]])
rb.planning.clearance(field, poses, car), rb.planning.clear(field, poses, car)

# %% [markdown]
# ## A search
#
# Algorithm 10.2 of Lynch and Park's *Modern Robotics*: six controls (straight on, left and right,
# ahead and back), each integrated exactly; one visit to each cell of position and heading; a price
# for each reversal. What it finds is what the controls do, so the same controls drive a robot.

# %%
steer = Controls.car(radius=0.6, turn=np.deg2rad(5.0), reversal=4)
plan = rb.planning.grid_dijkstra(
    grid, car, start=[0.8, 0.8, 0.0], goal=[4.2, 0.8, np.pi], controls=steer, headings=72
)
plan.status, plan.cost, len(plan.controls), plan.expanded

# %%
figure, ax = plt.subplots(figsize=(6, 4.5))
ax.imshow(walls.T, origin="lower", extent=(0, 5, 0, 4), cmap="Greys", vmax=2)
corners = np.array([[0.5, 0.175], [0.5, -0.175], [-0.2, -0.175], [-0.2, 0.175], [0.5, 0.175]])
for x, y, heading in plan.poses[::6]:
    c, s = np.cos(heading), np.sin(heading)
    outline = corners @ np.array([[c, s], [-s, c]]) + [x, y]
    ax.plot(*outline.T, color="tab:blue", alpha=0.3, lw=1)
ax.plot(*plan.poses[:, :2].T, color="tab:blue")
_ = ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")

# %% [markdown]
# A question without an answer is a status, not an error.

# %%
shut = OccupancyGrid(np.where(np.arange(100)[:, None] // 4 == 12, True, walls), 0.05)
rb.planning.grid_dijkstra(
    shut, car, start=[0.8, 0.8, 0.0], goal=[4.2, 0.8, np.pi], controls=steer, headings=72
).status

# %% [markdown]
# `grid_dijkstra_many` runs many searches on one map at once, as one compiled program, for an
# accelerator.

# %% [markdown]
# ## As fast as torques allow
#
# A path has no time. `time_scaling` gives the fastest motion along it within the torques of the
# drives, by the robot's dynamics. `refine` then changes the path, too: by gradients through the
# dynamics, clear of obstacles. It returns controls that drive the robot.

# %%
from rbjax import wheeled
from rbjax.planning import Limits, plan, refine, time_scaling
from rbjax.plotting import top_view

cells = np.zeros((100, 80), bool)
cells[40:46, :40] = True
room = OccupancyGrid(cells, 0.05)
shape = Footprint.rectangle(ahead=0.15, behind=0.15, width=0.5)
way = plan(room, shape, [1.0, 0.8, 0.5], [4.0, 0.8, -0.5], drive="differential").path
cart = wheeled.at(wheeled.kinds()["differential_drive"].make(caster=None), "reduced")
limits = Limits(torque=0.4, speed=1.0, turn_rate=2.0)
along = time_scaling(cart, way.split(0.02), limits)
quick = refine(cart, way.split(0.1), limits, room.distance_field(), shape)
print(f"along the path {along.motion.time:.2f} s; {quick.status}: {quick.motion.time:.2f} s")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharex=True, sharey=True)
for ax, (name, motion) in zip(
    axes, {"along the path": along.motion, "refined": quick.motion}.items(), strict=True
):
    torques, dt = motion.sampled(2000)
    start = wheeled.start(cart, pose=[1.0, 0.8, 0.5])
    driven = wheeled.rollout(cart, start, torques, dt, save_every=20)
    top_view(cart, driven, ax=ax, robots=8, grid=room)
    ax.set_title(f"{name}, {float(driven.ts[-1]):.1f} s")
