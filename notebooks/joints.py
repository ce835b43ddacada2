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
# # Your own joints
#
# A robot file has hinges, slides, balls and free joints. `model.with_joint(name, kind)` replaces
# one of them by another kind: a screw, a cylindrical, planar or universal joint, or a joint that
# you write.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import rbjax as rb
from rbjax.lanes import Mat3, Vec3
from rbjax.plotting import STYLE
from rbjax.spatial import Transform

plt.rcParams.update(STYLE)
jax.config.update("jax_enable_x64", True)
list(rb.joints.kinds())

# %% [markdown]
# ## A bead on a parabola
#
# A joint of k coordinates is the pose of its body relative to the joint's frame. Its axes S(q) and
# their rates are derivatives of the pose. The bead's frame stays upright. The height of the rail
# is a number of the model, so it can be differentiated.


# %%
class Parabola(rb.joints.Node):
    name, coordinates = "parabola", 1
    params = {"opening": 1.0}  # 1/m

    def pose(self, q, params):
        return Transform(Mat3.identity(), Vec3(q[0], 0.0, params[0] * q[0] * q[0]))


rb.joints.register(Parabola())
cart = rb.load("cart_pole")
cart = cart.replace(joints=cart.joints.replace(damping=[0.0, 0.0]))
# the joint's z is the axis of the one that it replaces: turn it up
bead = cart.with_joint("slider", "parabola", opening=0.5, axis=[0.0, 0.0, 1.0])
start = rb.State(jnp.array([1.0, 0.3]), jnp.zeros(2))
ts = jnp.linspace(0.0, 6.0, 601)
path = rb.simulate(bead, start, ts)

# %%
energy = jax.vmap(lambda q, v: rb.kinetic_energy(bead, q, v) + rb.potential_energy(bead, q))
E = energy(path.q, path.v)
print("energy kept to", float(abs(E / E[0] - 1).max()))
where = jax.vmap(lambda q: rb.forward_kinematics(bead, q).p)(path.q)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(where[:, 0, 0], where[:, 0, 2], lw=3, color="0.8", label="the rail")
tip = jax.vmap(lambda q: rb.forward_kinematics(bead, q))(path.q)
end = tip.p[:, 1] + tip.R[:, 1, :, 2] * 0.5
left.plot(end[:200, 0], end[:200, 2], lw=1, label="the pole's end, 2 s")
left.set(xlabel="x, m", ylabel="z, m", aspect="equal")
left.legend(frameon=False)
right.plot(ts, path.q[:, 0], label="bead, m")
right.plot(ts, path.q[:, 1], label="pole, rad")
right.set(xlabel="t, s")
right.legend(frameon=False)

# %% [markdown]
# ## Gradients
#
# The derivative of the bead's position after two seconds by the opening of its rail. It is
# one number, so forward mode is the cheaper one.


# %%
def after_two_seconds(opening):
    model = bead.replace(joints=bead.joints.replace(params=opening[None]))
    return rb.rollout(model, start, None, 0.005, steps=400, integrator="rk4").q[-1, 0]


print("m per 1/m:", jax.jacfwd(after_two_seconds)(jnp.array(0.5)).round(4))

# %% [markdown]
# ## A nut on a screw
#
# A nut on an upright screw turns as it falls. Only the part m p^2 / (I + m p^2) of its weight
# accelerates it, with the pitch p in metres a radian.

# %%
p = 0.05
body = rb.load("free_body").replace(gravity=[0.0, 0.0, -9.81])
puck = body.with_joint(body.joint_names[0], "screw", axis=[0.0, 0.0, 1.0], pitch=p)
a = p * rb.forward_dynamics(puck, *jnp.zeros((3, 1)))[0]
m, I = puck.bodies.mass[0], puck.bodies.inertia[0, 2, 2]
print("falls at", float(a), "m/s^2; by hand", float(puck.gravity[2] * m * p**2 / (I + m * p**2)))
