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
# # From rotations to a tumbling body
#
# An attitude has three degrees of freedom, but no three numbers describe all attitudes: every
# choice is singular somewhere. This notebook shows where. Then it writes the equations of one
# rigid body in many equivalent ways, and integrates them to see which ones fail, and when. It also
# shows the polhode, and a handle that turns over in free flight for no visible reason.

# %%
import functools
import warnings

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

from rbjax import body, spatial
from rbjax.plotting import INK, PALETTE, STYLE, Camera, Solid, draw_solids
from rbjax.rotations import incremental, quaternion, representations, se3, so3

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE | {"figure.dpi": 95})
BLUE, ORANGE, GREEN, PURPLE, RED, TEAL = PALETTE

# %% [markdown]
# ## One attitude, many numbers
# `representations()` has them all, including 24 Euler sequences, behind one interface: conversion
# to and from a matrix or a quaternion, the maps between their rates and the angular velocity, and
# the distance to the nearest singularity.

# %%
reps = representations()
turn = quaternion.exp([0.3, -0.5, 1.1])
print(f"{len(reps)} representations; one attitude in some of them, and the way to the singularity:")
some = "unit_quaternion axis_angle euler_vector gibbs mrp roll_pitch_yaw zyz"
for name in some.split():
    rep = reps[name]
    x = rep.from_quaternion(turn)
    away = np.degrees(rep.singularity_distance(x))
    where = rep.singular_set.split(":")[0]
    print(f"{name:16} {np.round(x, 4)!s:36} {away:6.1f} deg   {where}")

# %% [markdown]
# The rate map is `omega = E(x) x'`, and attitude inverse kinematics is its inverse, `x' = E^-1(x)
# omega`. The derivative of the matrix along this x' gives omega back, in body axes from R^T R', in
# space axes from R' R^T:

# %%
rpy = reps["roll_pitch_yaw"]
x, omega = rpy.from_quaternion(turn), jnp.array([0.2, -1.0, 0.7])
R, Rd = jax.jvp(rpy.to_matrix, (x,), (rpy.inverse_body_rate_matrix(x) @ omega,))
print("asked, body axes", omega, " found", so3.vee(R.T @ Rd))
print("     space axes", (R @ omega).round(6), " found", so3.vee(Rd @ R.T).round(6))

# %% [markdown]
# ## The singularity map
# All attitudes are a ball of rotation vectors of radius pi. A slice through its middle is a disc,
# with the identity in the centre and half turns about horizontal axes on the rim. Opposite points
# of the rim are the same attitude. The upper row shows the condition of E: how much larger the
# parameter rates can be than the angular velocity. The lower row shows the effect: the error of
# one classical Runge-Kutta step of 0.2 rad from each attitude. Quaternions treat all attitudes
# alike. The Gibbs vector is singular at half a turn. Roll-pitch-yaw is singular at two points of
# this disc, where the pitch is a right angle. zyz is singular at the identity and along the whole
# rim. The Euler vector and the modified Rodrigues parameters are singular at a full turn, outside
# of the disc.

# %%
across, turned = 141, 0.2 * jnp.array([0.36, 0.48, 0.8])
grid = np.linspace(-np.pi, np.pi, across)
phi = np.stack([*np.meshgrid(grid, grid), np.zeros((across, across))], -1).reshape(-1, 3) + 1e-4
SHOWN = {
    "unit_quaternion": "unit quaternion", "euler_vector": "Euler vector",
    "mrp": "modified Rodrigues", "gibbs": "Gibbs vector",
    "roll_pitch_yaw": "roll-pitch-yaw", "zyz": "zyz",
}  # fmt: skip


def rk4(slope, x, h):
    k1 = slope(x)
    k2 = slope(x + h / 2 * k1)
    k3 = slope(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))


@functools.partial(jax.jit, static_argnums=0)
def condition_and_error(rep, phi):
    q = quaternion.exp(phi)
    x = rep.from_quaternion(q)
    E = rep.body_rate_matrix(x)
    stepped = rk4(lambda x: (rep.inverse_body_rate_matrix(x) * turned).sum(-1), x, 1.0)
    truth = quaternion.multiply(q, quaternion.exp(turned))
    return E @ jnp.swapaxes(E, -1, -2), quaternion.distance(rep.to_quaternion(stepped), truth)


figure, axes = plt.subplots(2, 6, figsize=(13, 4.8), layout="constrained")
degrees = np.degrees(grid)
for (name, title), (upper, lower) in zip(SHOWN.items(), axes.T, strict=True):
    square, error = condition_and_error(reps[name], phi)
    values = np.linalg.eigvalsh(square)
    # singular values of E by those of E E^T, where rounding may leave less than nothing
    condition = np.sqrt(values[:, -1] / np.maximum(values[:, 0], 1e-8 * values[:, -1]))
    for axis, field, look in (
        (upper, condition, {"vmin": 0, "vmax": 2, "cmap": "viridis"}),
        (lower, error, {"vmin": -8, "vmax": 0, "cmap": "magma"}),
    ):
        rim = axis.add_patch(Circle((0, 0), 180, fill=False, edgecolor=INK, lw=1))
        field = np.log10(np.asarray(field)).reshape(across, across)
        shown = axis.pcolormesh(degrees, degrees, field, rasterized=True, **look)
        shown.set_clip_path(rim)
        axis.set(aspect="equal", xlim=(-184, 184), ylim=(-184, 184))
        axis.axis("off")
        if name == "zyz":
            what = "condition of E" if axis is upper else "error of a step [rad]"
            figure.colorbar(shown, ax=axis, label=f"log$_{{10}}$ {what}", shrink=0.8)
    upper.set_title(title)
note = {"color": "white", "fontsize": 8, "ha": "center", "va": "center"}
axes[0, 0].plot(0, 0, "+", color="white")
axes[0, 0].text(0, 22, "identity", **note)
axes[0, 0].text(118, 0, "half a turn\nabout x", **note)
axes[0, 0].text(0, 142, "half a turn\nabout y", **note)
plt.show()

# %% [markdown]
# ## One body, one signature
# A handle in the form of a T, made of two aluminium rods, is thrown with a spin. Its mass, centre
# and inertia follow from its shape. We put the frame at the centre of mass. The stem, along x, is
# the axis of the intermediate moment of inertia.

# %%
grip = spatial.shapes.cylinder(0.012, 0.16, density=2700.0)  # along z
stem = spatial.shapes.cylinder(0.010, 0.10, density=2700.0)
along_y = se3.pose(so3.exp([np.pi / 2, 0.0, 0.0]), np.zeros(3))
along_x = se3.pose(so3.exp([0.0, np.pi / 2, 0.0]), np.array([0.05, 0.0, 0.0]))
parts = spatial.transform_properties(along_y, *grip), spatial.transform_properties(along_x, *stem)
handle = spatial.shapes.combine(parts)
handle = spatial.transform_properties(se3.pose(np.eye(3), -handle.com), *handle)
thrown = body.rigid_body(handle, [body.UniformGravity()])
inertia = np.diag(np.asarray(handle.inertia))
print(f"mass {float(handle.mass):.3f} kg, moments {(1e4 * inertia).round(3)} kg cm^2")

# %% [markdown]
# There are Newton-Euler equations at the centre of mass or any point, Kirchhoff's equations from
# the kinetic energy, spatial vectors, momenta, Lagrange's equations in each attitude, and
# quasi-velocities. Every formulation has its own state, and all have one signature, `initial`,
# `rate`, `pose`, `twist`. So one function integrates all of them; `f.term()` is the term for
# diffrax.


# %%
@functools.partial(jax.jit, static_argnums=0)
def motion(f, situation, T, V, ts):
    """Poses, body twists and distances to the singularity at times ts, which are the steps."""
    solution = diffrax.diffeqsolve(
        f.term(), diffrax.Dopri8(), ts[0], ts[-1], None, f.initial(situation.body, T, V), situation,
        stepsize_controller=diffrax.StepTo(ts), saveat=diffrax.SaveAt(ts=ts), max_steps=len(ts),
        adjoint=diffrax.ForwardMode(), throw=False,
    )  # fmt: skip

    def seen(y):
        return f.pose(situation.body, y), f.twist(situation.body, y), f.singularity_distance(y)

    return jax.vmap(seen)(solution.ys)


LINES = {
    "newton_euler": ("Newton-Euler", INK), "quasi_lagrange": ("quasi-Lagrange", TEAL),
    "kirchhoff": ("Kirchhoff", INK), "spatial_world": ("spatial, world axes", INK),
    "momentum_world": ("momentum, world axes", "#8a8f94"),
    "lagrange_mrp": ("Lagrange, modified Rodrigues", BLUE),
    "lagrange_gibbs": ("Lagrange, Gibbs vector", PURPLE),
    "lagrange_roll_pitch_yaw": ("Lagrange, roll-pitch-yaw", ORANGE),
    "lagrange_zyz": ("Lagrange, zyz", RED),
}  # fmt: skip
ts = np.linspace(0, 2, 301)
start = se3.pose(so3.exp([1.53, 1.18, 0.41]), [0.0, 0.0, 1.5])
V0 = jnp.array([4.5, 5.5, 2.5, 0.5, 0.0, 4.0])
runs = {
    name: [np.asarray(x) for x in motion(body.formulation(name), thrown, start, V0, ts)]
    for name in LINES
}
fine = motion(body.formulation("newton_euler"), thrown, start, V0, np.linspace(0, 2, 1201))
truth = [np.asarray(x)[::4] for x in fine]


def apart(T, truth):
    """The angle between attitudes, pi where there is none any more."""
    lost = ~np.isfinite(T).all((1, 2))
    R = np.where(lost[:, None, None], np.eye(3), T[:, :3, :3])
    turn = so3.log(truth[:, :3, :3].transpose(0, 2, 1) @ R)
    return np.where(lost, np.pi, np.linalg.norm(turn, axis=1))


print("after                            0.5 s       1 s       2 s  (attitude error, rad)")
for name, (title, _) in LINES.items():
    print(f"{title:28}", *(f"{apart(runs[name][0], truth[0])[i]:9.0e}" for i in (75, 150, 300)))

# %% [markdown]
# ## Which fails where, and when
# All formulations take the same steps. Each Lagrangian one is as accurate as any until its motion
# comes near its own singularity (below), and it never recovers what it loses there. No torque acts
# on the handle about its centre of mass, so its angular momentum is constant. Its drift (middle)
# reveals a failure without a reference. Momentum about a fixed point of the world is never
# singular, but here it is a thousand times larger than the spin, so digits are lost.


# %%
def momentum_drift(T, V):
    L = np.einsum("tij,tj->ti", T[:, :3, :3], inertia * V[:, :3])
    return np.linalg.norm(L - L[0], axis=1) / np.linalg.norm(L[0])


figure, axes = plt.subplots(3, 1, figsize=(9, 7.8), sharex=True, layout="constrained")
for name in (n for n in LINES if n not in ("kirchhoff", "spatial_world")):
    T, V, away = runs[name]
    title, colour = LINES[name]
    axes[0].semilogy(ts[1:], np.maximum(apart(T, truth[0]), 1e-16)[1:], color=colour, label=title)
    with np.errstate(invalid="ignore"):
        axes[1].semilogy(ts[1:], np.maximum(momentum_drift(T, V), 1e-16)[1:], color=colour)
    if np.isfinite(away).any():
        axes[2].plot(ts, np.degrees(away), color=colour)
axes[0].set(ylabel="attitude error [rad]", title="One throw, one step size")
figure.legend(loc="outside upper right", ncols=4, fontsize=8)
axes[1].set(ylabel="drift of angular momentum")
axes[2].set(ylabel="to the singularity [deg]", xlabel="time [s]", ylim=(0, 185))
plt.show()

# %% [markdown]
# ## The torque-free top: the polhode
# In the body's own axes the angular velocity stays on two surfaces: the ellipsoid of its energy,
# and the ellipsoid of its angular momentum (a sphere in momentum coordinates). Their intersection
# is the polhode. About the axes of the smallest and the largest moment the polhodes are closed
# loops. The separatrix (black) goes through the intermediate axis, and any motion that starts near
# it must travel to the other side. Each loop is integrated over its closed-form period
# 4 K(k^2) / lambda (Landau and Lifshitz, 37), in 300 steps. The closed loops confirm both.

# %%
least, middle, most = np.argsort(inertia)
A, B, C = inertia[[least, middle, most]]


def flip_period(omega):
    """4 K(k^2) / lambda (n,) of body rates omega (n, 3): once around the polhode."""
    twoE, L2 = omega**2 @ inertia, omega**2 @ inertia**2
    a, c = np.where(twoE * B > L2, C, A), np.where(twoE * B > L2, A, C)
    rate = np.sqrt((c - B) * (L2 - twoE * a) / (a * B * c))
    k2 = (B - a) * (twoE * c - L2) / ((c - B) * (L2 - twoE * a))
    return 4 * ellipk(k2) / rate


reach = np.sqrt(1 / inertia)  # semi-axes of the ellipsoid of twice the energy 1 J
edge = {least: (B - A) / (C - A), most: (C - B) / (C - A)}  # the separatrix, from either axis
loops = []
for axis, other in ((least, most), (most, least)):
    for share in np.linspace(0.1, 0.985, 8):
        for side in (-1, 1):
            w = np.zeros(3)
            w[other] = reach[other] * share * np.sqrt(edge[axis])
            w[axis] = side * reach[axis] * np.sqrt(1 - share**2 * edge[axis])
            loops.append(w)
loops = np.array(loops)
steps = np.linspace(0, 1, 301) * flip_period(loops)[:, None]
top = functools.partial(motion, body.formulation("kirchhoff"), thrown, start)
twists = jax.jit(jax.vmap(top))(np.pad(loops, ((0, 0), (0, 3))), steps)[1]
polhodes = np.asarray(twists[..., :3])
gap = np.linalg.norm(polhodes[:, -1] - polhodes[:, 0], axis=1) / np.linalg.norm(loops, axis=1)
print(f"{len(loops)} loops, closed to {gap.max():.0e}")

# %%
order = [least, middle, most]
azimuth, elevation = np.radians([52, 24])
eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation)])  # fmt: skip
u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 121), np.linspace(0, np.pi, 61))
ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
theta = np.linspace(0, 2 * np.pi, 400)
separatrix = [
    np.stack([np.sqrt(edge[most]) * np.cos(theta), np.sin(theta),
              side * np.sqrt(edge[least]) * np.cos(theta)], -1) * reach[order]
    for side in (-1, 1)
]  # fmt: skip
curves = [(w[:, order], "Blues" if k >= len(loops) // 2 else "Oranges", (k // 2) % 8)
          for k, w in enumerate(polhodes)]  # fmt: skip


def trace(axis, points, normal, **look):
    """A curve on a convex surface, its far side faint."""
    front = (normal @ eye > 0)[:, None]
    axis.plot(*np.where(front, points, np.nan).T, zorder=3, **look)
    axis.plot(*np.where(front, np.nan, points).T, zorder=2, alpha=0.12, **look)


figure = plt.figure(figsize=(11, 5.4))
moments = inertia[order]
for column, title in enumerate(("energy ellipsoid", "momentum sphere")):
    axis = figure.add_axes((0.5 * column, -0.04, 0.5, 1.0), projection="3d", computed_zorder=False)
    sphere = column == 1
    size = np.ones(3) if sphere else reach[order]
    light = np.clip(np.einsum("iab,i->ab", ball, eye), 0, 1)
    colours = plt.get_cmap("Greys")(0.42 - 0.34 * light)
    axis.plot_surface(*(size[:, None, None] * ball), facecolors=colours, rstride=1, cstride=1,
                      linewidth=0, antialiased=False, shade=False, zorder=1)  # fmt: skip
    for w, colourmap, k in [*curves, *((w, None, 0) for w in separatrix)]:
        L = moments * w
        points = L / np.linalg.norm(L, axis=1, keepdims=True) if sphere else w
        colour = plt.get_cmap(colourmap)(0.9 - 0.06 * k) if colourmap else INK
        trace(axis, points, L, color=colour, lw=1.2 if colourmap else 2.2)
    for k, name in enumerate(("least", "intermediate", "greatest")):
        ahead = np.eye(3)[k]
        tip, end = size[k] * ahead, (size[k] + (0.3, 0.75, 0.2)[k] * size.max()) * ahead
        axis.plot(*np.stack([tip, end]).T, color=INK, lw=1.2, zorder=4)
        aside = {"ha": ("right", "center", "center")[k], "va": ("center", "top", "bottom")[k]}
        axis.text(*end, f" {name} ", fontsize=9, zorder=5, **aside)
    axis.set(xlim=(-size.max(), size.max()), ylim=(-size.max(), size.max()),
             zlim=(-size.max(), size.max()))  # fmt: skip
    axis.set_proj_type("ortho")
    axis.set_box_aspect((1, 1, 1), zoom=1.15)
    axis.view_init(np.degrees(elevation), np.degrees(azimuth))
    axis.set_axis_off()
    what = "directions of angular momentum" if sphere else "angular velocity at 0.5 J"
    middle_of = {"x": 0.25 + 0.5 * column, "ha": "center"}
    figure.text(y=0.95, s=f"Polhodes on the {title}", weight="bold", fontsize=11, **middle_of)
    figure.text(y=0.02, s=f"{what}, body axes", fontsize=9, **middle_of)
plt.show()

# %% [markdown]
# ## Dzhanibekov's handle
# The handle spins about its stem, the intermediate axis, with a hundredth of the spin across it. It
# follows a loop next to the separatrix: it keeps its direction for a long time, then turns over
# within a moment, again and again. The dotted lines mark the flips of the closed form, every half
# period. They come from Jacobi's functions, not from this integration.

# %%
spin = np.zeros(3)
spin[middle], spin[most] = 12.0, 0.12
ts = np.linspace(0, 6, 301)
upright = se3.pose(so3.exp([0.0, -np.pi / 2, 0.0]), np.zeros(3))
T, V, _ = (np.asarray(x) for x in motion(
    body.formulation("kirchhoff"), thrown, upright, np.r_[spin, 0, 0, 0], ts
))  # fmt: skip
period = float(flip_period(spin))
flips = np.arange(period / 4, ts[-1], period / 2)
w = V[:, :3]
at = np.flatnonzero(np.sign(w[1:, middle]) != np.sign(w[:-1, middle]))
found = ts[at] - w[at, middle] * np.diff(ts)[at] / np.diff(w[:, middle])[at]
print("flips predicted", flips.round(3), "s, found", found.round(3), "s")


def rod(radius, length, pose, colour):
    ring = np.linspace(0, 2 * np.pi, 25)
    rim = np.stack([radius * np.cos(ring), radius * np.sin(ring), 0 * ring + length / 2], -1)
    points = np.concatenate([rim, rim * [1, 1, -1]])
    pose = np.asarray(pose)
    return Solid(points @ pose[:3, :3].T + pose[:3, 3], 0, colour, 1.0)


com = np.asarray(spatial.shapes.combine(parts).com)
shift = se3.pose(np.eye(3), -com)
shape = [rod(0.012, 0.16, shift @ along_y, (0.91, 0.51, 0.16)),
         rod(0.010, 0.10, shift @ along_x, (0.16, 0.44, 0.69))]  # fmt: skip

figure, (above, below) = plt.subplots(
    2, 1, figsize=(10, 4.2), height_ratios=[1, 3.4], layout="constrained"
)
camera, spacing = Camera(azimuth=-90, elevation=14), 0.58  # metres of picture a second
for k, i in enumerate(range(7, 300, 15)):
    place = camera.axes[0] * spacing * ts[i]
    R, style = T[i, :3, :3][None], {"camera": camera, "shadow": False, "zorder": 2 + k}
    draw_solids(shape, R, place[None], ax=above, **style)
above.set(xlim=(0, spacing * ts[-1]), ylim=(-0.11, 0.11), aspect="equal")
above.axis("off")
for k, name, colour in ((middle, "stem (intermediate)", BLUE), (least, "grip (least)", ORANGE),
                        (most, "across both (greatest)", GREEN)):  # fmt: skip
    below.plot(ts, w[:, k], color=colour, label=name)
for flip in flips:
    below.axvline(flip, color=INK, ls=":", lw=1)
below.set(xlabel="time [s]", ylabel="angular velocity,\nbody axes [rad/s]",
          xlim=(0, ts[-1]), ylim=(-14, 19))  # fmt: skip
below.legend(loc="upper center", ncols=3)
plt.show()

# %% [markdown]
# ## Error and drift of the representations
# Without torque, the angular momentum L in space is constant, so the attitude is the only state:
# `x' = E^-1(x) I^-1 R(x)^T L` in any representation, with three numbers or nine. Here eight of them
# follow the throw above with the same Runge-Kutta steps of 5 ms. Three numbers fail at their
# singularities, and axis and angle at a full turn. More than three drift off their constraint
# (bottom left). The right side shows some of them as *increments*: a local parameter is integrated,
# and folded into a reference attitude half-way to its singularity (bottom right). Now none fails.

# %%
moments, ts = jnp.asarray(inertia), np.linspace(0, 2, 401)
q0 = quaternion.from_matrix(start[:3, :3])
L = start[:3, :3] @ (moments * V0[:3])


def omega(t, q):
    return quaternion.rotate(quaternion.conjugate(q), L) / moments


@functools.partial(jax.jit, static_argnums=0)
def follow(rep, q0, ts):
    def slope(x):
        return rep.inverse_body_rate_matrix(x) @ (rep.to_matrix(x).T @ L / moments)

    def step(x, h):
        x = rk4(slope, x, h)
        return x, (x, rep.to_quaternion(x), rep.singularity_distance(x))

    return jax.lax.scan(step, rep.from_quaternion(q0), jnp.diff(ts))[1]


@functools.partial(jax.jit, static_argnums=0)
def follow_increments(local, q0, ts):
    def step(state, h):
        def slope(x):
            here = state._replace(x=x)
            return incremental.rate(here, omega(0.0, incremental.attitude(here, local)), local)

        state = incremental.fold(state._replace(x=rk4(slope, state.x, h)), local)
        away = reps[local].singularity_distance(state.x)
        return state, (incremental.attitude(state, local), away)

    return jax.lax.scan(step, incremental.start(q0), jnp.diff(ts))[1]


exact = incremental.integrate(omega, q0, np.linspace(0, 2, 16 * 400 + 1))[16::16]


def from_truth(q):
    lost = ~(np.linalg.norm(q, axis=1) > 0)  # nan as well
    angles = quaternion.distance(np.where(lost[:, None], [1.0, 0.0, 0.0, 0.0], q), exact)
    return np.maximum(np.where(lost, np.pi, angles), 1e-16)


def off_orthonormal(R):
    R = R.reshape(-1, 3, 3)
    return np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max((1, 2))


GLOBAL = {
    "unit_quaternion": ("unit quaternion", INK), "rotation_matrix": ("rotation matrix", TEAL),
    "axis_angle": ("axis and angle", "#8a8f94"), "euler_vector": ("Euler vector", GREEN),
    "mrp": ("modified Rodrigues", BLUE), "gibbs": ("Gibbs vector", PURPLE),
    "roll_pitch_yaw": ("roll-pitch-yaw", ORANGE), "zyz": ("zyz", RED),
}  # fmt: skip
CONSTRAINT = {
    "unit_quaternion": lambda x: (x**2).sum(1) - 1,
    "axis_angle": lambda x: (x[:, :3] ** 2).sum(1) - 1,
    "rotation_matrix": off_orthonormal,
}
figure, axes = plt.subplots(2, 2, figsize=(11, 6.4), sharex=True, layout="constrained")
(error, folded), (drift, near) = axes
for name, (title, colour) in GLOBAL.items():
    x, q, _ = (np.asarray(y) for y in follow(reps[name], q0, ts))
    look = {"color": colour, "label": title}
    error.semilogy(ts[1:], from_truth(q), **look)
    if name in CONSTRAINT:
        drift.semilogy(ts[1:], np.maximum(np.abs(CONSTRAINT[name](x)), 1e-17), **look)
    if name in ("mrp", "gibbs", "roll_pitch_yaw"):
        q, away = (np.asarray(y) for y in follow_increments(name, q0, ts))
        folded.semilogy(ts[1:], from_truth(q), **look)
        near.plot(ts[1:], np.degrees(away), color=colour)
error.set(ylabel="attitude error [rad]", title="One set of parameters all the way", ylim=(1e-12, 9))
error.legend(ncols=3, fontsize=8, loc="lower right")
folded.set(title="As increments, folded in time", ylim=error.get_ylim())
folded.legend(ncols=3, fontsize=8, loc="lower right")
drift.set(xlabel="time [s]", ylabel="off the constraint", title="More than three numbers drift")
drift.legend(fontsize=8, loc="upper left")
near.set(xlabel="time [s]", ylabel="increment to its singularity [deg]", ylim=(0, 370),
         title="Increments keep clear")  # fmt: skip
plt.show()

# %% [markdown]
# ## Other libraries at the singular points
# At removable singularities (no turn, half a turn, a matrix in gimbal lock) there is a right
# answer. The table shows the results of other libraries in f64, the worst of 500 attitudes or
# directions (`python -m benchmarks.accuracy.rotation_libraries`; manifpy was not available). *lock*
# is gimbal lock of intrinsic z-y-x angles, d the distance to it in rad:
#
# | library | where | result |
# | --- | --- | --- |
# | jaxlie 1.5.0 | `SE3.exp` at zero | d translation / d rotation is twice too large |
# | jaxlie 1.5.0 | `SE3.exp`, turns of 0, 1e-3, 1e-2 | second derivatives off by 0.7, 2e-8, 3e-11 |
# | jaxlie 1.5.0 | `SE3.jlog`, identity | reverse-mode derivative is nan |
# | pytransform3d 3.17 | `euler_from_matrix`, d = 1e-5, 1e-6 | attitude off by 4e-11, 5e-10 |
# | pytransform3d 3.17 | the same, d = 1e-7 and less, but not 0 | attitude off by 2 d |
# | pytransform3d 3.17 | axis and angle, turns of pi - 1e-5, pi - 1e-7 | attitude off by 2e-11 |
# | scipy 1.17 | `as_euler`, d = 1e-7 and less, but not 0 | warns, attitude off by 2 d |
# | scipy 1.17, jaxlie 1.5.0 | logarithm, turns up to pi | right to rounding |
#
# The results of rbjax and of the installed scipy, from intrinsic z-y-x angles to a matrix and back:

# %%
rng = np.random.default_rng(0)
zyx = reps["intrinsic_zyx"]
print("from lock      rbjax      scipy    (attitude error of a round trip, rad, worst of 500)")
for d in (1e-3, 1e-5, 1e-7, 1e-8, 1e-9, 0.0):
    angles = rng.uniform(-3, 3, (500, 3))
    angles[:, 1] = np.pi / 2 - d
    R = np.asarray(zyx.to_matrix(angles))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scipy says "Gimbal lock detected"
        theirs = Rotation.from_euler("ZYX", Rotation.from_matrix(R).as_euler("ZYX")).as_matrix()
    ours = zyx.to_matrix(zyx.from_matrix(R))
    errors = (np.linalg.norm(so3.log(jnp.swapaxes(R, 1, 2) @ X), axis=1) for X in (ours, theirs))
    print(f"{d:9.0e}", *(f"{e.max():10.1e}" for e in errors))
