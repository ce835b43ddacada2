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
# # How a floor slips
#
# A robot on three omnidirectional wheels drives straight on a table, on brown and gray cloth and on
# green carpet, in 72 directions. Its encoders say how its wheels turned, a camera above says where
# it went. On carpet it gets half as far as its wheels say. How it slips depends on the heading:
# wheels carry unequal loads, and rollers resist. What must be known of a floor to tell by the
# wheels where the robot is?
#
# The recordings (github.com/BrOleg5/research-wheel-slippage, Apache-2.0) are in
# `../shared/data/robotino_omni_slip`, outside the repository. Without them this notebook only says
# so.

# %%
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import rbjax
from rbjax import wheeled
from rbjax.plotting import STYLE
from rbjax.sysid import Channel, Recording
from rbjax.sysid.torque import select
from rbjax.wheeled.robot.catalogue import omnidirectional

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

DATA = Path(rbjax.__file__).parents[2] / "shared" / "data" / "robotino_omni_slip"
FLOORS = ["table", "brown", "gray", "green"] if DATA.exists() else []
if not FLOORS:
    print(f"The recordings are not there ({DATA.name}): nothing is computed below.")

# %% [markdown]
# ## The robot and its runs
#
# The geometry is nominal. A run becomes 36 even steps; encoders count 2000 ticks a turn of a motor,
# with gears of 16. The picture's axes point down and right. Headings of 0, 10, 20, ... degrees are
# fitted, 5, 15, 25, ... are kept for the verdict.

# %%
ARM, STEPS, TICK = 0.125, 36, 2 * np.pi / 2000 / 16
robot = omnidirectional([float(a) for a in np.deg2rad([60, 180, 300])], arm=ARM, radius=0.04)


def run(c):
    """heading in degrees, speed in m/s, and on even times the wheels' angles and the poses."""
    t = c["t"] / 1000
    angles = TICK * np.stack([c[f"m{i}pos"] for i in (1, 2, 3)], 1)
    yaw = np.unwrap(np.deg2rad(c["ang"]))
    poses = np.stack([-1.83716e-3 * c["ypos"], -1.84046e-3 * c["xpos"], yaw], 1)
    both = {"other:wheels": Channel(t, angles), "other:camera": Channel(t, poses)}
    even = np.linspace(t[0], t[-1], STEPS + 1)
    on = Recording("run", both).on_clock(even, gap=1.0)
    v = complex(c["xsetspeed"][-1], c["ysetspeed"][-1])
    heading = 5 * round(np.angle(v, deg=True) / 5) % 360
    return heading, round(abs(v), 1), even, on["other:wheels"].values, on["other:camera"].values


runs = {}
for floor in FLOORS:
    file = np.load(DATA / f"for_research_movement_direction__one_surface_type__{floor}_surface.npz")
    tables = [file[name] for name in file.files if name.startswith("exp")]
    runs[floor] = [run(dict(zip(file["columns"], x.T, strict=True))) for x in tables]
    print(f"{floor:6s} {len(runs[floor])} runs at {sorted({r[1] for r in runs[floor]})} m/s")


# %% [markdown]
# ## What encoders say
#
# `odometry` integrates the twist at which the wheels would roll. The share of that path that the
# camera saw:


# %%
def shares(some, slip=None):
    """Of each run, the length that the camera saw over that by the wheels."""
    out = []
    for _, _, t, angles, poses in some:
        end = np.asarray(wheeled.odometry(robot, t, angles, slip))[-1]
        out.append(np.hypot(*(poses[-1] - poses[0])[:2]) / np.hypot(*end[:2]))
    return np.array(out)


def by_heading(ax, slips):
    for color, (floor, some) in zip(plt.cm.tab10.colors, runs.items(), strict=False):
        for speed, mark in ((0.1, "o"), (0.2, "s"), (0.3, "^")):
            at = sorted((r for r in some if r[1] == speed), key=lambda r: r[0])
            if at:
                label = f"{floor}, {speed} m/s"
                ax.plot([r[0] for r in at], shares(at, slips.get(floor)), mark + "-", ms=2, lw=0.6,
                        color=color, alpha=1.3 - 3 * speed, label=label)  # fmt: skip
    ax.set(xlabel="heading [deg]", ylabel="camera / wheels", xticks=range(0, 361, 60))
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)


if FLOORS:
    figure, ax = plt.subplots(figsize=(9, 3.6))
    by_heading(ax, {})
    ax.set_title("encoders, nominal geometry")
    plt.show()

# %% [markdown]
# ## How much to model
#
# One effective radius would move these curves up or down. `HeadingSlip` says the robot's twist by
# the twist at which its wheels would roll, with harmonics of the heading; the first one by itself
# is linear, as unequal wheels with viscous slip would be. Dry friction of three wheels adds the
# fifth and the seventh. Terms with the speed may be added.
#
# All is linear in the coefficients, so `select` fits the models one after the other, and keeps a
# term where chance would not explain what it explains. A run is one equation, as errors within a
# run are alike; divided by its speed, so that relative errors count.


# %%
def identified(some):
    """The slip of a floor, with no more than these runs need."""
    shapes = {f"up to harmonic {K}": wheeled.HeadingSlip.none(ARM, K) for K in (1, 2, 3, 5)}
    if len({r[1] for r in some}) > 1:
        for K, J in ((5, 0), (5, 1), (5, 3), (7, 3)):
            shapes[f"up to harmonic {K}, {J} with speed"] = wheeled.HeadingSlip.none(ARM, K, J)
    else:
        shapes["up to harmonic 7"] = wheeled.HeadingSlip.none(ARM, 7)
    size = np.array([1.0, 1.0, ARM])
    seen, rolled, per = [], [], []
    for _, _, t, angles, poses in some:
        seen.append(size * np.asarray(wheeled.mean_twists(t, poses)).mean(0))
        rolled.append(wheeled.rolled_twists(robot, np.diff(angles, axis=0) / np.diff(t)[:, None]))
        per.append((t[-1] - t[0]) / np.hypot(*(poses[-1] - poses[0])[:2]))
    rolled, per = np.stack(rolled), np.array(per)
    models = {"one radius": ((size * rolled).mean(1)[..., None] * per[:, None, None], ["radius"])}
    for name, shape in shapes.items():
        W = np.asarray(shape.columns(rolled)).mean(1) * per[:, None, None]
        models[name] = W, [str(i) for i in range(W.shape[-1])]
    found = select(models, np.array(seen) * per[:, None])
    shape = shapes[found.name]
    C = found.regression.parameters(np.zeros(shape.coefficients.size))
    return found, shape.replace(coefficients=C.reshape(3, -1))


slips = {}
for floor, some in runs.items():
    found, slips[floor] = identified([r for r in some if r[0] % 10 == 0])
    print(f"{floor}: {found.name}")
    for comparison in found.comparisons:
        print("   ", comparison.summary())

# %% [markdown]
# ## The verdict, on headings that were not fitted
#
# The error is 1 - camera / wheels, in %: its mean over headings, and the mean absolute error of one
# run. The mean is a mild test, which one radius would pass too. On table, brown and gray single
# runs are right within 1 %. The green carpet does not repeat itself: runs differ from the mean of
# their two neighbours by about 3 %, which no smooth model explains.

# %%
for floor, some in runs.items():
    unseen = [r for r in some if r[0] % 10 == 5]
    print(f"{floor:6s}", end="")
    for name, slip in (("encoders", None), ("identified", slips[floor])):
        e = 100 * (1 - shares(unseen, slip))
        print(f"   {name}: mean {e.mean():6.2f}, of one run {np.abs(e).mean():5.2f}", end="")
    off = []
    for speed in {r[1] for r in some}:
        x = shares(sorted((r for r in some if r[1] == speed), key=lambda r: r[0]))
        off.append(2 * x / (np.roll(x, 1) + np.roll(x, -1)) - 1)
    repeats = 100 * np.sqrt(np.mean(np.concatenate(off) ** 2) / 1.5)
    print(f"   runs repeat within {repeats:.2f} (standard deviation)")

if FLOORS:
    figure, ax = plt.subplots(figsize=(9, 3.6))
    by_heading(ax, slips)
    ax.axhspan(0.98, 1.02, color="gray", alpha=0.2, lw=0)
    ax.set(title="with the slip of each floor; gray: 2 %", ylim=(0.8, 1.2))
    plt.show()

# %% [markdown]
# ## Where the robot goes
#
# Three runs on the carpet that were not fitted. The wheels also say how slip turns the robot: it
# drives arcs, whose ends one radius would miss.

# %%
if FLOORS:
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), sharey=True)
    for ax, heading in zip(axes, (35, 215, 335), strict=True):
        some = [r for r in runs["green"] if r[0] == heading and r[1] == 0.2]
        _, _, t, angles, poses = some[0]
        x, y = (poses[:, :2] - poses[0, :2]).T
        ax.plot(x, y, "k", lw=2, label="camera")
        for name, slip in (("encoders", None), ("identified", slips["green"])):
            first = [0.0, 0.0, poses[0, 2]]
            path = np.asarray(wheeled.odometry(robot, t, angles, slip, pose=first))
            ax.plot(path[:, 0], path[:, 1], "--", label=name)
        ax.set(title=f"heading {heading} deg", xlabel="x [m]", xlim=(-0.1, 1.6), aspect="equal")
    axes[0].set_ylabel("y [m]")
    axes[2].legend(fontsize=9)
    plt.show()
