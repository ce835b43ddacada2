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
# # Loops
#
# A constraint is part of the model. It comes from the file (`<connect>`, `<weld>`, `<joint>`, a
# URDF's `mimic`) or from `model.with_constraints(...)`. `rollout`, `simulate`, `step` and
# `linearise` enforce it.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax import constraints as rc
from rbjax.plotting import STYLE

plt.rcParams.update(STYLE)
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Closing a four-bar
#
# In the bundled scene `four_bar` two rods stand on a beam, 1 m apart. A third one, the coupler,
# hangs on the tip of the left rod. A `<connect>` at its end closes the loop. Here the loop is taken
# off and closed again explicitly, with a ball joint. The loop is planar, so one of the three rows
# of the joint is redundant. Redundant rows need no special treatment.

# %%
tree = rb.load("four_bar").replace(constraints=())
ball = rc.Spherical.between(tree, "coupler", "right", point=[1.0, 0.0, 2.3])
model = tree.with_constraints(ball)
start = model.keyframe("turning")
print(rc.residual(model, start))
print(rc.jacobian(model, start.q).round(3))

# %% [markdown]
# ## Through the dead points
#
# The parallelogram is flat twice a turn. There the rows lose rank and another branch begins. Rows
# that vanish are damped, so that fixed and adaptive steps pass, in f32 too.

# %%
path = rb.rollout(model, start, None, 1e-3, steps=4000, integrator="rk4", save_every=20)
energy = jax.vmap(lambda q, v: rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q))
E = energy(path.q, path.v)
gap = jax.vmap(lambda q, v: jnp.abs(rc.residual(model, rb.State(q, v)).value).max())
print("energy kept to", float(abs(E - E[0]).max()), "J; gap", float(gap(path.q, path.v).max()), "m")

# %%
forces = jax.vmap(lambda q, v: rc.joint_wrenches(model, rb.State(q, v))[0, 3:])(path.q, path.v)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(path.ts, path.q[:, 0] / (2 * jnp.pi))
left.set(xlabel="t, s", ylabel="turns of the left rod")
right.plot(path.ts, forces[:, 0], label="x")
right.plot(path.ts, forces[:, 2], label="z")
right.set(xlabel="t, s", ylabel="force on the right rod, N")
right.legend(frameon=False)

# %% [markdown]
# ## A link length from a measured motion
#
# Where the ball sits on the coupler is a number of the model. Someone measures the left rod for
# half a second. The derivative of the motion by the length goes through the loop.


# %%
def with_length(length):
    place = ball.a.replace(position=jnp.zeros(3).at[0].set(length))
    return tree.with_constraints(ball.__class__(place, ball.b))


def angles(length):
    longer = with_length(length)
    begin = rc.Projection(iterations=8).project(longer, 0.0, start)
    return rb.rollout(longer, begin, None, 2e-3, steps=250, integrator="rk4").q[::10, 0]


both = jax.jit(lambda length: jax.jvp(angles, (length,), (1.0,)))  # the angles and their slope
measured, _ = both(1.07)
length = 1.0
for _ in range(4):
    found, slope = both(length)
    length = length - slope @ (found - measured) / (slope @ slope)
    print(f"length {length:.9f} m")

# %% [markdown]
# ## Andrews' squeezer
#
# Seven planar bodies in four chains that meet in one point E, a spring, a motor on K1: the test
# of multibody codes (Schiehlen 1990; figures of Hairer & Wanner, *Solving ODEs II*, VII.7). Three
# loop joints close it, and their multipliers are the forces in E.


# %%
def body(name, at, com, mass, inertia, inside=""):
    return (
        f'<body name="{name}" pos="{at} 0"><joint name="{name}" axis="0 0 1"/>'
        f'<inertial pos="{com} 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
        f"{inside}</body>"
    )


k2 = body("K2", "0.007 0", "-0.0115 0", 0.00365, 4.41e-7)
k4 = body("K4", "0.04 0", "0 -0.00579", 0.00706, 5.667e-7)
k6 = body("K6", "0 -0.04", "0.00579 0", 0.00706, 5.667e-7)
bodies = [
    body("K1", "0 0", "0.00092 0", 0.04325, 2.194e-6, k2),
    body("K3", "-0.03635 0.03273", "0.01043 -0.01874", 0.02373, 5.255e-6),
    body("K5", "-0.06934 -0.00227", "0.02308 0.00916", 0.0705, 1.169e-5, k4),
    body("K7", "-0.06934 -0.00227", "0.01228 0.00449", 0.05498, 1.912e-5, k6),
]
tree = rb.load(
    f"""<mujoco><option gravity="0 0 0"/><worldbody>{"".join(bodies)}</worldbody>
    <actuator><motor joint="K1"/></actuator></mujoco>"""
)
on = rb.forces.Place.on
ends = on(point=[0.014, 0.072, 0]), on(body="K3", point=[0.02, -0.018, 0])
spring = rb.forces.PointSpring.of(*ends, stiffness=4530.0, length=0.07785)
E = {"K2": [-0.028, 0, 0], "K3": [0, -0.035, 0], "K4": [0, -0.02, 0], "K6": [0.02, 0, 0]}
at = {name: rc.Place.on(body=name, point=point) for name, point in E.items()}
loops = [rc.Spherical(at[name], at["K2"]) for name in ("K3", "K4", "K6")]
squeezer = tree.with_forces(spring).with_constraints(*loops)
angles0 = {"K1": -0.0617, "K2": 0.0, "K3": 0.4553, "K4": 0.2227, "K5": 0.4874, "K6": -0.2227}
guess = jnp.array([angles0.get(name, 1.2305) for name in squeezer.joint_names])
begin = rc.assemble(squeezer, squeezer.default_state().replace(q=guess), pinned=["K2"]).state
print(rc.mobility(squeezer, begin.q))

# %%
motor = jnp.array([0.033])  # N m
held = jnp.tile(motor, (3000, 1))
path = rb.rollout(squeezer, begin, held, 1e-5, integrator="rk4", save_every=10)
l = jax.vmap(lambda q, v: rc.multipliers(squeezer, rb.State(q, v), motor))(path.q, path.v)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
turn = jnp.array([squeezer.joint(name) for name in ("K1", "K3", "K7")])
left.plot(1e3 * path.ts, path.q[:, turn], label=["K1", "K3", "K7"])
left.set(xlabel="t, ms", ylabel="angle, rad")
right.plot(1e3 * path.ts, l.reshape(-1, 3, 3)[:, :, 0], label=["K3", "K4", "K6"])
right.set(xlabel="t, ms", ylabel="x of the force of K2 in E, N")
for axes in (left, right):
    axes.legend(frameon=False)

# %% [markdown]
# ## Which formulation
#
# `recommend` runs the candidates on a motion and says in a sentence which one to take, and why.

# %%
crank = model.keyframe("turning").replace(q=2.2 * jnp.array([1.0, -1.0, 1.0]), v=jnp.zeros(3))
choice = rb.recommend.formulation(model, crank, 1e-6, horizon=0.5, dt=0.01, progress=False)
print(choice.name, choice.dt)
print(choice.reason)
