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
# # An arm reaches under torque limits
#
# `rb.control.Problem` says what a motion shall do; `rb.control.solve` finds the controls that cost
# least, and a feedback with them. An arm of seven joints brings its tool to a pose in 1 s with
# drives that are hardly strong enough. A push then shows what the feedback is worth. At the end a
# smaller arm is designed together with its motion.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax.control import Control, Cost, Design, Point, Pose, Problem, Velocity, solve
from rbjax.plotting import STYLE, Camera, strobe

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

# %% [markdown]
# ## Servos become motors
# The file of this arm has position servos. An actuator's force is gain times control plus a bias,
# so a gain of 1 and no bias make a motor. The control is then a torque, within its range.

# %%
arm = rb.load("arm7")
limit = jnp.array([50.0, 50.0, 35.0, 35.0, 6.0, 6.0, 4.0])  # N m
servos = arm.actuators
motors = servos.replace(
    gain=jnp.zeros((7, 3)).at[:, 0].set(1.0),
    bias=jnp.zeros((7, 3)),
    ctrlrange=jnp.stack([-limit, limit], 1),
)
arm = arm.replace(actuators=motors)
start = arm.keyframe("home")

# %% [markdown]
# ## The goal
# The hand turns a quarter round to the left, lifts, and points its fingers ahead. A cost of
# residuals counts half their square. Running costs are rates per second. The first guess of the
# torques holds the arm against gravity.

# %%
turned = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # fingers ahead
goal = Pose(turned, jnp.array([0.2, 0.5, 0.75]), site="tool")


def posture(t, state, ctrl):
    """Away from home, rad: keeps the elbow from wandering."""
    return state.q - start.q


problem = Problem(
    arm, 50, 0.02,
    running=[Cost(posture, 5.0), Cost(Velocity(), 0.5), Cost(Control(), 1e-3)],
    terminal=[Cost(goal, 1e4), Cost(Velocity(), 10.0)],
)  # fmt: skip
hold = rb.gravity_forces(arm, start.q)
reach = solve(problem, start, ctrl=jnp.tile(jnp.clip(hold, -limit, limit), (50, 1)))
off = goal(arm, 0.0, reach.state(-1), reach.ctrl[-1])
print(f"{reach.summary()} after {int(reach.iterations)} iterations, cost {float(reach.cost):.4f}")
print(f"off by {1e3 * jnp.linalg.norm(off[:3]):.2f} mm, {jnp.linalg.norm(off[3:]):.1e} rad")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), gridspec_kw={"width_ratios": [1.2, 1, 1]})
strobe(arm, reach.states.q[::10], ax=axes[0], source="arm7", camera=Camera(-30, 20))
axes[0].axis("off")
steps = axes[1].step(reach.ts[:-1], reach.ctrl / limit, where="post")
steps[-1].set_color("k")
axes[1].set(xlabel="time [s]", ylabel="torque / limit", ylim=(-1.1, 1.1))
axes[1].legend(arm.joint_names, fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
axes[2].semilogy(reach.costs[: int(reach.iterations)], ".-")
axes[2].set(xlabel="iteration", ylabel="cost")
figure.tight_layout()

# %% [markdown]
# ## A push
# From 0.1 s to 0.2 s, 30 N push the hand aside. The same torques, open loop, miss the goal; the
# feedback of the solution sees where the arm is and corrects, within the same limits. Its gains
# came with the solution. `rb.rollout` takes the policy as it takes torques.

# %%
hand = arm.body("link7")
push = jnp.zeros((50, len(arm.bodies.mass), 6)).at[5:10, hand, 4].set(-30.0)
runs = {
    "open loop": rb.rollout(arm, start, reach.ctrl, 0.02, wrenches=push),
    "feedback": rb.rollout(arm, start, reach.policy(), 0.02, steps=50, wrenches=push),
}


@jax.jit
@jax.vmap
def distance(q):
    """From the tool to the goal, m."""
    return jnp.linalg.norm(rb.frame_pose(arm, q, site="tool")[1] - goal.position)


figure, axis = plt.subplots(figsize=(7, 3.2))
axis.axvspan(0.1, 0.2, color="0.9")
axis.plot(reach.ts, distance(reach.states.q), "k--", lw=1, label="planned")
for name, run in runs.items():
    axis.plot(run.ts, distance(run.q), label=f"{name}: {1e3 * distance(run.q)[-1]:.0f} mm off")
axis.set(xlabel="time [s]", ylabel="tool to goal [m]", title="30 N for 0.1 s")
axis.legend()
figure.tight_layout()

# %% [markdown]
# ## Lengths and motion, designed together
# A planar arm with two links swings its tip from low to a point ahead, to be there from 1 s on. A
# `Design` is a function that puts numbers into the model; the solver finds them with the torques.
# Here they are the lengths of both links, from 0.3 to 1.5 m.

# %%
small = rb.load("two_link")
low = rb.State(jnp.array([0.3, 0.3]), jnp.zeros(2))
corner = jnp.array([0.9, 0.0, 2.3])
tip = Point(corner, site="tip")


def with_lengths(model, p):
    """The arm with links of lengths p; its masses sit at their ends."""
    bodies, sites = model.bodies, model.sites
    com = bodies.com.at[:, 2].set(-p)
    position = bodies.position.at[1, 2].set(-p[0])
    ends = sites.position.at[0, 2].set(-p[1])
    return model.replace(
        bodies=bodies.replace(com=com, position=position), sites=sites.replace(position=ends)
    )


def late(model, t, state, ctrl):
    """The tip's way to the corner, weighed from 1 s on."""
    return 40.0 * jax.nn.sigmoid((t - 1.0) / 0.02) * tip(model, t, state, ctrl)


def task(design):
    return Problem(
        small, 40, 0.04, design=design,
        running=[Cost(Control(), 1e-2), late], terminal=[Cost(Velocity(), 10.0)],
    )  # fmt: skip


found = {
    "as it is": solve(task(None), low),
    "designed": solve(task(Design(with_lengths, [1.0, 1.0], 0.3, 1.5)), low),
}
for name, one in found.items():
    print(f"{name}: {one.summary()}, {int(one.iterations)} iterations, cost {float(one.cost):.3f}")
print("lengths", found["designed"].parameters, "m")

# %% [markdown]
# The 2 kg of the elbow come as near to the shoulder as the bounds allow, and the arm is just long
# enough: it arrives stretched.


# %%
def corners(model, q):
    """Shoulder, elbow and tip (3, 3)."""
    return jnp.stack([*rb.forward_kinematics(model, q).p, rb.frame_pose(model, q, site="tip")[1]])


figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
for axis, (name, one) in zip(axes, found.items(), strict=False):
    for k, points in enumerate(jax.vmap(corners, (None, 0))(one.model, one.states.q[::4])):
        axis.plot(points[:, 0], points[:, 2], "o-", color="tab:blue", alpha=0.2 + 0.08 * k, ms=3)
    axis.plot(corner[0], corner[2], "*", color="tab:orange", ms=14, zorder=5)
    axis.set(title=f"{name}: cost {float(one.cost):.2f}", xlabel="x [m]", ylabel="z [m]")
    axis.set(aspect="equal", xlim=(-0.6, 1.6), ylim=(0.4, 2.8))
    axes[2].plot(one.ts[:-1], jnp.linalg.norm(one.ctrl, axis=1), label=name)
axes[2].set(xlabel="time [s]", ylabel="norm of the torques [N m]")
axes[2].legend()
figure.tight_layout()
