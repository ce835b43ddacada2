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
# # Flexible links
#
# A beam is a link of the robot's tree. Its coordinates are the Legendre coefficients of its
# strains, and its tip carries other bodies, sites and forces. A cantilever is compared with
# elliptic integrals. A cable swings. A beam spins up, in strain coordinates and as a modal body.
# Fingers close by tendons. Bending stiffness and damping are identified from a swing.
# `docs/guides/flexible.md` has the theory.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.flexible import beam, circle
from rbjax.flexible.modal import (
    BeamSection,
    Interface,
    add_modal_body,
    beam_mesh,
    craig_bampton,
    fast_rotation,
)
from rbjax.plotting import BLUE, INK, ORANGE, STYLE, Camera, strobe

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)
WORLD = rb.load("<mujoco/>")
STILL = rb.load('<mujoco><option gravity="0 0 0"/></mujoco>')

# %% [markdown]
# ## Elastica
#
# A cantilever under a dead load across its tip, P L^2 / EI = 10. Equilibrium is a minimum of
# q K q / 2 - P y(q). In Legendre coefficients of the curvature, K is the diagonal EI L / (2 j + 1).
# The answer has elliptic integrals. A beam of n coordinates is the beam of 10 with the others at
# zero, so one program solves all n. Rigid links with springs are the simplest discrete beam.

# %%
LOAD, EXACT = 10.0, np.array([1 - 0.5549955977537513, 0.8106090248802965])
MOST, links = 10, (4, 8, 16)


def equilibrium(tip, stiffness, free):
    """The position of the tip, in ten steps of the load, with the coordinates of a mask free."""

    def energy(q, load):
        return stiffness @ q**2 / 2 - load * tip(q)[1]

    def newton(q, load):
        slope = jax.hessian(energy)(q, load) * jnp.outer(free, free) + jnp.diag(1 - free)
        return q - jnp.linalg.solve(slope, jax.grad(energy)(q, load) * free)

    q, _ = jax.lax.scan(
        lambda q, load: (jax.lax.fori_loop(0, 8, lambda _, q: newton(q, load), q), None),
        jnp.zeros(len(stiffness)),
        LOAD * jnp.arange(1, 11) / 10,
    )
    return tip(q)


rod = beam(1.0, [1.0, 1.0, 1.0, 0, 0, 0], {"k_z": MOST - 1}, mass=1.0).joint()
K = 1 / (2 * jnp.arange(MOST) + 1)
masks = jnp.tril(jnp.ones((MOST, MOST)))
solve = jax.vmap(
    lambda free: equilibrium(
        lambda q: jnp.stack(rod.poses(list(q), rod.defaults)[rod.tip].p[:2]), K, free
    )
)
error = np.abs(jax.jit(solve)(masks) - EXACT).max(1)


@jax.jit
def tip_of_links(springs):
    def tip(q):
        turned = jnp.cumsum(q)
        return jnp.stack([jnp.cos(turned).mean(), jnp.sin(turned).mean()])

    return equilibrium(tip, springs, jnp.ones(len(springs)))


link_error = [np.abs(tip_of_links(n * jnp.ones(n).at[0].set(2.0)) - EXACT).max() for n in links]
for n in (4, 8, 10):
    print(f"{n:2} coordinates: error {error[n - 1]:.1e}")
print(f"{links[-1]} rigid links: error {link_error[-1]:.1e}")

figure, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
ax.semilogy(range(1, MOST + 1), error, "o-", label="strain coordinates")
ax.semilogy(links, link_error, "s-", label="rigid links with springs")
ax.set(xlabel="coordinates", ylabel="error of the tip / L", title="Elastica")
ax.legend()
plt.show()

# %% [markdown]
# ## A swinging cable
#
# A rubber cable of 1.5 m is two beams in series, held at one end and released at rest. The
# integrator `discrete` is linearly implicit in stiffness and damping. They are constant diagonals
# in these coordinates, so a step costs no more than an explicit one. The tip snaps like a whip.

# %%
rubber = circle(0.012, E=2e6, nu=0.48, density=1100.0)
part = beam(0.75, rubber, {"k_y": 2}, damping=0.01)
cable = WORLD.with_beam("a", part).with_beam("b", part, "a")
swing = rb.rollout(
    cable, cable.default_state(), None, 1e-3, steps=1500, integrator="discrete", save_every=10
)
tip = rb.plotting.poses(cable, np.asarray(swing.q))[1][:, cable.body("b")]
speed = np.linalg.norm(np.gradient(tip, np.asarray(swing.ts), axis=0), axis=1)
print("largest speed of the tip", speed.max().round(2), "m/s")

figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", width_ratios=[2, 1])
strobe(cable, swing.q[:76:5], ax=axes[0], camera=Camera(-90, 5), trace="b", shadow=False)
axes[0].set(title="Released from the left end, 0.75 s")
axes[1].plot(swing.ts, speed)
axes[1].set(xlabel="t, s", ylabel="m/s", title="Speed of the tip")
plt.show()

# %% [markdown]
# ## Spin-up
#
# A beam of 10 m on a hub whose speed grows to 6 rad/s in 15 s (Kane, Ryan & Banerjee 1987; Simo &
# Vu-Quoc 1986). The beam lags, and centrifugal forces stiffen it. Published digits: the largest lag
# is 0.5738 m, at 6.76 s. The inertia of the hub is so large that the torque determines its motion.

# %%
L, EI, EA, MASS = 10.0, 1.4e4, 2.8e7, 1.2
HUB = """<mujoco><option gravity="0 0 0"/><worldbody><body name="hub">
  <joint name="turn" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1e9 1e9 1e9"/>
  </body></worldbody></mujoco>"""
W, DT = 2 * np.pi / 15, 5e-3
hub = rb.load(HUB)


def spin_up(model, seconds):
    """Times, and the lag of the tip: its y in the axes of the hub."""
    t = DT * np.arange(round(seconds / DT))
    tau = np.zeros((len(t), model.nv))
    tau[:, 0] = 1e9 * 0.4 * (1 - np.cos(W * t)) * (t < 15)
    run = rb.rollout(
        model, model.default_state(), None, DT, tau=jnp.asarray(tau), integrator="discrete",
        save_every=10,
    )  # fmt: skip
    R, p = rb.plotting.poses(model, np.asarray(run.q))
    return np.asarray(run.ts), np.einsum("ti,ti->t", R[:, 0, :, 1], p[:, model.body("arm")])


arm = beam(L, [EI, EI, EI, EA, 0, 0], {"k_z": 3, "e_x": 1}, mass=MASS, inertia=[6e-4, 0, 6e-4])
lags = {"strain coordinates": spin_up(hub.with_beam("arm", arm, "hub"), 20.0)}
t, lag = lags["strain coordinates"]
print(f"strain coordinates: largest lag {lag.min():.4f} m at {t[lag.argmin()]:.2f} s")

# %% [markdown]
# The same beam as a modal body: finite elements, reduced by Craig and Bampton to two modes in the
# plane. Linear modes alone are wrong: the stiffness in rotation is omega_1^2 - Omega^2, which is
# negative at 6 rad/s, and the deflection diverges. `fast_rotation` detects it before a simulation.
# Geometric stiffening adds the second-order displacements of the modes.

# %%
section = BeamSection(EA=EA, EIy=2 * EI, EIz=EI, GJ=EI, mass=MASS, rotary=(1e-3, 0.0, 0.0))
mesh = beam_mesh(np.linspace([0.0, 0, 0], [L, 0, 0], 21), section)
ends = [Interface("root", [0]), Interface("tip", [20])]
for stiffening in (True, False):
    body = craig_bampton(mesh, ends, 8, frame="root", keep=6, stiffening=stiffening)
    planar = np.flatnonzero(np.abs(np.asarray(body.first_moment1)).argmax(0) == 1)[:2]
    body = body.with_modes(planar)
    print(fast_rotation(body, [0.0, 0.0, 6.0]).status)
    name = "modal body" if stiffening else "modal body, no stiffening"
    lags[name] = spin_up(add_modal_body(hub, "arm", body, "hub"), 20.0 if stiffening else 9.5)

# %%
figure, ax = plt.subplots(figsize=(8, 3.2), layout="constrained")
for (name, (t, lag)), style in zip(lags.items(), ("-", "--", "-"), strict=True):
    ax.plot(t, lag, style, label=name)
ax.plot(6.76, -0.573835, "x", color=INK, label="published")
ax.set(xlabel="t, s", ylabel="lag of the tip, m", title="Spin-up", ylim=(-1.5, 0.2))
ax.legend()
plt.show()

# %% [markdown]
# ## Fingers that close
#
# Three tapered fingers of soft rubber. A tendon from the base to the tip pulls at the tip with a
# moment M, so the curvature is M / EI(s): it is largest where the finger is thin. The angle of the
# tip is the integral of M / EI. The springs of a tapered beam are a full matrix of coefficients.

# %%
COUNT, LENGTH, MOMENT, POINTS = 3, 0.12, 0.009, 7
nodes = 0.5 + 0.5 * np.polynomial.legendre.leggauss(POINTS)[0]
radius = 0.009 - 0.003 * nodes
soft = circle(radius, E=4e5, nu=0.48, density=1100.0)
finger = beam(LENGTH, soft, {"k_y": 2}, damping=0.05, points=POINTS)
PALM = """<mujoco><option gravity="0 0 0"/><worldbody>
  <geom type="cylinder" size="0.06 0.01" pos="0 0 0.15" rgba="0.45 0.5 0.55 1"/>
  </worldbody></mujoco>"""
hand, bending = rb.load(PALM), []
for k in range(COUNT):
    a = 2 * np.pi * k / COUNT
    out, down = np.array([np.cos(a), np.sin(a), 0.0]), np.array([0.0, 0.0, -1.0])
    axes = np.stack([down, np.cross(out, down), out], -1)  # x down, z outwards
    turned = rb.rotations.quaternion.from_matrix(axes)
    hand = hand.with_beam(
        f"finger {k}", finger, position=0.045 * out + [0, 0, 0.14], orientation=turned
    )
    bending.append(axes[:, 1])
steps = 600
pull = np.zeros((steps, hand.nb, 6))
pull[:, :, :3] = MOMENT * np.minimum(np.arange(steps) / 400, 1)[:, None, None] * bending
close = rb.rollout(
    hand, hand.default_state(), None, 2e-3, wrenches=jnp.asarray(pull), integrator="discrete",
    save_every=10,
)  # fmt: skip
R, _ = rb.plotting.poses(hand, np.asarray(close.q[-1:]))
turn = np.arctan2(-R[0, 0, :, 0] @ [1, 0, 0], -R[0, 0, 2, 0])
s = np.linspace(0, LENGTH, 1001)
exact = np.trapezoid(MOMENT / (4e5 * np.pi / 4 * (0.009 - 0.003 * s / LENGTH) ** 4), s)
print(f"angle of the tip {turn:.4f} rad, integral of M / EI {exact:.4f} rad")

figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for ax, k in zip(axes, (0, 20, 60), strict=True):
    rb.plotting.draw(hand, close.q[k], ax=ax, source=PALM, camera=Camera(-75, 12))
    ax.set(title=f"M = {1e3 * MOMENT * min(k / 40, 1):.1f} N mm")
    ax.set(xlim=axes[0].get_xlim(), ylim=axes[0].get_ylim())
plt.show()

# %% [markdown]
# ## Stiffness and damping from a swing
#
# A horizontal strip is released and swings. A marker at its tip is seen 100 times a second, with
# noise of 1 mm. `rb.sysid.identify` fits the bending stiffness and the viscosity of the section,
# from first guesses that are wrong by factors of two and three.

# %%
TRUE = {"EI": 0.36, "viscosity": 0.36 * 0.004}


def strip(EI, viscosity):
    of = beam(0.5, [0, EI, 0, 0, 0, 0], {"k_y": 1}, mass=0.5, damping=viscosity / EI)
    return WORLD.with_beam("strip", of)


rng = np.random.default_rng(0)
grid = rb.sysid.Grid(0.005, 1, "rk4")
start = strip(**TRUE).default_state()
truth = rb.rollout(strip(**TRUE), start, None, 0.005, steps=400, integrator="rk4", save_every=2)
clock, marker = np.asarray(truth.ts), rb.plotting.poses(strip(**TRUE), np.asarray(truth.q))[1][:, 0]
seen = marker + 1e-3 * rng.normal(size=marker.shape)
first = np.full((len(clock), 2), np.nan)
first[0] = 0.0  # it starts straight and at rest
known = {x: rb.sysid.Channel(clock, first, noise=np.ones(2), dropped="nan") for x in ("q", "v")}
recording = rb.sysid.Recording(
    "swing", known | {"other:marker": rb.sysid.Channel(clock, seen, noise=np.full(3, 1e-3))}
)
unknowns = {
    "EI": rb.sysid.Unknown("forces.0.stiffness", 1, positive=True),
    "viscosity": rb.sysid.Unknown("forces.0.viscosity", 1, positive=True),
}
setup = rb.sysid.Setup.of(strip(0.72, 0.0005)).with_sensors(
    {"other:marker": rb.sensors.Position("strip")}
)
found = rb.sysid.identify(setup, recording, unknowns, grid=grid, estimate_initial_state=False)
for name, true in TRUE.items():
    of = found.estimates.interval(name)
    print(f"{name:9} {of.value:.5f} in [{of.low:.5f}, {of.high:.5f}], true {true:.5f}")
print("failed checks of the fit:", found.verdict.failed or "none")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained", width_ratios=[1, 2])
strobe(strip(**TRUE), truth.q[:15:2], ax=axes[0], camera=Camera(-90, 0), shadow=False)
axes[0].set(title="Released")
fits = {"first guess": (strip(0.72, 0.0005), ORANGE), "identified": (found.model, BLUE)}
axes[1].plot(clock, seen[:, 2], ".", ms=3, color=INK, label="seen")
for name, (model, color) in fits.items():
    own = rb.rollout(model, start, None, 0.005, steps=400, integrator="rk4", save_every=2)
    z = rb.plotting.poses(model, np.asarray(own.q))[1][:, 0, 2]
    axes[1].plot(clock, z, color=color, label=name)
axes[1].set(xlabel="t, s", ylabel="height of the tip, m", title="A swing")
axes[1].legend()
plt.show()
