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
# # A quadrotor through a gate
#
# A quadrotor flies 4 m in 2 s. Half way, after 1 s, it must pass a narrow gate that leans by 60
# degrees, so it must lean as well. Its rotors only push, with 0 to 6 N each. The gate is a cost
# that depends on time; then it is a constraint.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.control import Constraint, Control, Cost, Pose, Problem, StateError, Velocity, solve
from rbjax.plotting import STYLE

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

quad = rb.load("quadrotor")
hover = quad.keyframe("hover")
thrust = 9.81 / 4  # N, of each rotor

# %% [markdown]
# ## The task
# `Pose` compares the frame with the gate's: log of the relative transform, (6,). A bell in time
# makes it count near 1 s. `StateError` compares states on the tangent space, attitudes included.


# %%
def at(x):
    """Hovering at x."""
    return rb.State(hover.q.at[0].set(x), hover.v)


lean = np.deg2rad(60.0)
c, s = np.cos(lean), np.sin(lean)
R = jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
gate = Pose(R, jnp.array([0.0, 0.0, 1.4]), body="frame")


def at_gate(model, t, state, ctrl):
    """Off the gate, weighed near 1 s."""
    return 60.0 * jnp.exp(-(((t - 1.0) / 0.04) ** 2)) * gate(model, t, state, ctrl)


easy = [Cost(Velocity(), 0.02), Cost(Control(thrust), 0.02)]
goal = Cost(StateError(at(2.0)), 100.0)
problem = Problem(quad, 80, 0.025, running=[*easy, at_gate], terminal=[goal])
flight = solve(problem, at(-2.0), ctrl=jnp.full((80, 4), thrust))
print(f"{flight.summary()} after {int(flight.iterations)} iterations")
print("off the gate", gate(quad, 1.0, flight.state(40), flight.ctrl[40]).round(4))

# %% [markdown]
# ## Seen from the side and over time
# It climbs, rolls onto its side with two rotors at rest, passes the gate, and catches itself.
# Thrusts of zero are bounds: the solver holds them exactly.

# %%
poses = jax.vmap(lambda q: rb.forward_kinematics(quad, q))
a = 0.17  # m, from the hub to a rotor along each axis
arms = np.array([[a, a, 0], [-a, -a, 0], [0, 0, 0], [-a, a, 0], [a, -a, 0]])


def draw(axis, states, every=5):
    """The quadrotor's cross, at every so many knots, and the gate."""
    found = poses(states.q)
    at, turned = np.asarray(found.p)[:, 0], np.asarray(found.R)[:, 0]
    for k in range(0, len(at), every):
        axis.plot(*(arms @ turned[k].T + at[k]).T, color=plt.cm.viridis(k / len(at)), lw=2)
    axis.plot(*at.T, color="0.5", lw=0.8)
    frame = np.array([[0, y, z] for y, z in ((-0.4, -0.15), (0.4, -0.15), (0.4, 0.15),
                                             (-0.4, 0.15), (-0.4, -0.15))])  # fmt: skip
    frame = frame @ np.asarray(gate.rotation).T + np.asarray(gate.position)
    axis.plot(*frame.T, color="tab:red", lw=3)
    axis.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", zlim=(0.5, 2.0), ylim=(-0.8, 0.8))
    axis.set(yticks=[-0.5, 0.5], zticks=[0.5, 1.0, 1.5, 2.0])
    axis.set_box_aspect((4, 1.6, 1.5), zoom=1.2)
    axis.view_init(12, -50)


figure = plt.figure(figsize=(11, 4))
draw(figure.add_subplot(1, 2, 1, projection="3d"), flight.states)
axis = figure.add_subplot(2, 2, 2)
axis.step(flight.ts[:-1], flight.ctrl, where="post")
axis.set(ylabel="thrusts [N]", xticklabels=[])
axis = figure.add_subplot(2, 2, 4)
w, x, y, z = flight.states.q[:, 3:].T
axis.plot(flight.ts, np.rad2deg(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))))
axis.plot(1.0, 60.0, "o", color="tab:red")
axis.set(xlabel="time [s]", ylabel="roll [deg]")
figure.tight_layout()

# %% [markdown]
# ## The gate as a constraint
# The cost above is a compromise: it leaves millimetres. A `Constraint` holds to 1e-6. It is said
# for all knots, so its window in time is a factor: outside it, zero, which is within any bounds.
# The attitude may now be off by 5 degrees, as a wide gate allows, and the cost is lower.

# %%
window = Constraint(
    lambda model, t, state, ctrl: (abs(t - 1.0) < 0.01) * gate(model, t, state, ctrl),
    low=[-1e-3] * 3 + [-np.deg2rad(5)] * 3, high=[1e-3] * 3 + [np.deg2rad(5)] * 3, name="gate",
)  # fmt: skip
held = Problem(quad, 80, 0.025, running=easy, terminal=[goal], constraints=[window])
strict = solve(held, at(-2.0), states=flight.states, ctrl=flight.ctrl)
print(f"{strict.summary()} after {int(strict.iterations)} iterations")
print("off the gate", gate(quad, 1.0, strict.state(40), strict.ctrl[40]).round(4))
effort = [float(((x.ctrl - thrust) ** 2).sum() * 0.025) for x in (flight, strict)]
print("effort as a cost {:.2f} N^2 s, as a constraint {:.2f} N^2 s".format(*effort))

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), subplot_kw={"projection": "3d"})
for axis, (name, one) in zip(axes, {"cost": flight, "constraint": strict}.items(), strict=True):
    draw(axis, one.states)
    axis.set_title(f"the gate as a {name}", y=0.9)
figure.tight_layout()
