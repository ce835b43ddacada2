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
# # Two robots of the book, term by term
#
# Chapter 8 of Olguín Díaz, *3D Motion of Rigid Bodies*, works out two mobile robots: one on
# omnidirectional wheels, whose constraints leave all its velocities free, and one with a
# differential drive, which may not slide sideways. Two ways lead to their equations. The *dynamical
# approach* eliminates multipliers. The *kinematical approach* separates twists, w = S v, and with
# them wrenches. Here is what both are in numbers.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import wheeled
from rbjax.plotting import STYLE, top_view
from rbjax.wheeled import Body, Drive, Robot, Wheel

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)


def equations(robot, fidelity, v, u):
    """M and f of M v' = f + B u at velocities v, from accelerations: they are affine in u."""
    vehicle = wheeled.at(robot, fidelity)
    state = wheeled.start(vehicle).replace(v=jnp.asarray(v))
    acceleration = jax.jit(lambda u: wheeled.rates(vehicle, state, u).v)
    return acceleration(jnp.asarray(u))


# %% [markdown]
# ## The differential drive
#
# Wheels of radius r and axial inertia J stand at y = b and y = -b. The centre of mass is d ahead
# of the axle. The free velocities are the speed v of the middle of the axle and the turning rate w:
# the wheels turn at (v -+ b w) / r. With both wheels' masses in m and I,
#
#     (m + 2 J / r^2) v'            - m d w^2 = (t_r + t_l) / r
#     (I + m d^2 + 2 J b^2 / r^2) w' + m d v w = b (t_r - t_l) / r

# %%
m, I, d, b, r, J = 10.0, 0.4, 0.15, 0.2, 0.08, 0.01
drive = Robot.of(
    Body(m, I, com=[d, 0.0]),
    [Wheel([0.0, -b], radius=r, inertia=J), Wheel([0.0, b], radius=r, inertia=J)],
    [Drive((0,)), Drive((1,))],
)
v, w, right, left = 0.7, 1.3, 0.3, -0.1
due = np.array([
    ((right + left) / r + m * d * w**2) / (m + 2 * J / r**2),
    (b * (right - left) / r - m * d * v * w) / (I + m * d**2 + 2 * J * b**2 / r**2),
])  # fmt: skip
print("by hand            ", due)
for fidelity in ("dynamical", "reduced", "quasi_velocities"):
    print(f"{fidelity:19s}", equations(drive, fidelity, [v, w], [right, left]))

# %% [markdown]
# The rows of the wheels do no work: the power of the motors is the rate of the kinetic energy. The
# multibody model agrees, in which each wheel is a body and each contact three rows.

# %%
full = wheeled.at(drive, "constrained")
state = wheeled.start(full, twist=[v, 0.0, w])
rate = wheeled.rates(full, state, jnp.array([right, left]))
print("full model         ", np.asarray(rate.v)[[0, 2]])
print("sideways: v_y' =   ", f"{float(rate.v[1]):.1e}", "in the axes of the chassis")
contact = wheeled.contacts(full, state, jnp.array([right, left]))
print("forces on wheels, ahead and to the left [N]:")
print(np.round(np.asarray(contact.forces), 3))

# %% [markdown]
# ## Chaplygin's error
#
# It is tempting to put the constraints into the kinetic energy first, T(v, w), and then to apply
# Lagrange's equations to it. The terms m d w^2 and m d v w then vanish: v and w seem to be
# constant without torque. The cart shows that they are not.

# %%
carts = wheeled.at(drive, "reduced")
start = wheeled.start(carts, twist=[0.2, 0.0, 2.5])
path = wheeled.rollout(carts, start, jnp.zeros((500, 2)), 0.01)
figure, (one, two) = plt.subplots(1, 2, figsize=(10, 3.6), width_ratios=[3, 2])
top_view(carts, path, ax=one, robots=5)
two.plot(path.ts, path.v, label=["speed [m/s]", "turning rate [rad/s]"])
two.hlines([0.2, 2.5], 0, 5, colors="gray", linestyles="--", lw=1)
two.annotate("Lagrange with substituted constraints", (5, 2.45), ha="right", va="top", color="gray")
two.set(xlabel="time [s]")
two.legend(loc="center right")
plt.show()
energy = 0.5 * (m + 2 * J / r**2) * path.v[:, 0] ** 2
energy += 0.5 * (I + m * d**2 + 2 * J * b**2 / r**2) * path.v[:, 1] ** 2
print("energy at the start and at the end [J]:", float(energy[0]), float(energy[-1]))

# %% [markdown]
# ## The omnidirectional robot
#
# Wheels i stand at the angles a_i on a circle of radius L, and roll along it. Their speeds follow
# from the twist (x, y, w) of the chassis, in its own axes:
#
#     r phi_i' = -sin(a_i) x + cos(a_i) y + L w,     phi' = A (x, y, w) / r
#
# All velocities are free, S is the identity for the chassis, and the kinematical approach gives
#
#     (M + J A^T A / r^2) V' + w x (M V) = A^T t / r,    V = (x, y, w)
#
# The wheels add 3 J / (2 r^2) to the mass and 3 J L^2 / r^2 to the inertia, and nothing to the
# Coriolis terms: they do not turn with the chassis' momentum.

# %%
L, M = 0.18, np.diag([m, m, I])
omni = Robot.of(
    Body(m, I),
    [
        Wheel([L * np.cos(a), L * np.sin(a)], heading=a + np.pi / 2, radius=r, inertia=J,
              kind="rollers")
        for a in 2 * np.pi / 3 * np.arange(3)
    ],
    [Drive((i,)) for i in range(3)],
)  # fmt: skip
a = 2 * np.pi / 3 * np.arange(3)
A = np.stack([-np.sin(a), np.cos(a), np.full(3, L)], -1)
V, torques = np.array([0.5, -0.2, 1.1]), np.array([0.2, 0.1, 0.3])
momentum = M @ V
coriolis = np.array([-V[2] * momentum[1], V[2] * momentum[0], 0.0])
due = np.linalg.solve(M + J * A.T @ A / r**2, A.T @ torques / r - coriolis)
print("by hand            ", due)
for fidelity in ("dynamical", "reduced", "quasi_velocities"):
    print(f"{fidelity:19s}", equations(omni, fidelity, V, torques))
added = J * A.T @ A / r**2
print("added by wheels    ", np.diag(added), "of", 1.5 * J / r**2, 3 * J * L**2 / r**2)

# %% [markdown]
# ## What each approach costs
#
# Operations of one evaluation of the accelerations, with the robot known to the program. The
# kinematical approach has no multipliers to solve for.

# %%
from rbjax.compiler import explain

for name, robot in (("differential drive", drive), ("omnidirectional", omni)):
    for fidelity in ("reduced", "dynamical"):
        vehicle = wheeled.at(robot, fidelity)
        state = wheeled.start(vehicle)

        def rates(state, u, vehicle=vehicle):
            return wheeled.rates(vehicle, state, u)

        found = explain(rates, state, jnp.zeros(vehicle.nu))
        print(f"{name:20s} {fidelity:12s} {found.operations} operations")
