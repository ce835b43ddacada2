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
# # Walking: limit cycles and their eigenvalues
#
# The motion of a walking machine is smooth from one impact of a foot to the next. The state after
# an impact is a function P of the state after the impact before, the *return map*. A gait is a
# fixed point of P. It is stable if the eigenvalues of P' lie inside the unit circle. The time of
# the impact depends on the state, so P' needs the derivative of an event.
# `rb.solvers.integrate_until` has it for any vector field, and `rb.simulate_impacts` for the
# contacts of a robot file. `rb.stability.limit_cycle` finds the fixed point by Newton's method.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE
from rbjax.solvers import integrate_until

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)
G = 9.81

# %% [markdown]
# ## The rimless wheel
#
# A hub on eight spokes rolls down a slope. Each spoke that strikes the ground takes a share of the
# speed, and gravity gives it back. Between two impacts the wheel is a pendulum on one foot, with
# the angle from the vertical and its rate. The rate after an impact is the only coordinate of the
# return map, which has a closed form.

# %%
ALPHA, SLOPE, GYRATION = np.pi / 8, 0.08, 0.3
J = GYRATION**2
ETA = (J + np.cos(2 * ALPHA)) / (J + 1)


def fall(t, y, args):
    return jnp.stack([y[1], G / (1 + J) * jnp.sin(y[0])])


def roll(rate):
    """The motion on one foot, from an impact to the next."""
    start = jnp.concatenate([jnp.array([SLOPE - ALPHA]), rate])
    return integrate_until(fall, start, lambda t, y, _: SLOPE + ALPHA - y[0], 3.0, tolerance=1e-12)


wheel_cycle = rb.stability.limit_cycle(lambda rate: ETA * roll(rate).y[1:], [1.5])
period = float(roll(wheel_cycle.state).t)
drop = 4 * G / (1 + J) * np.sin(ALPHA) * np.sin(SLOPE)
exact = ETA * np.sqrt(drop / (1 - ETA**2))
print(f"rate after an impact {wheel_cycle.state[0]:.12f}, closed form {exact:.12f}")
print(f"eigenvalue           {wheel_cycle.eigenvalues[0].real:.12f}, closed form {ETA**2:.12f}")

# %% [markdown]
# The same wheel as a robot file has a plane and a small sphere at the end of each spoke. Moreau's
# time stepping (`rb.contact.MoreauContact`) solves for the impulses of impacts and of lasting
# contacts alike, without events. Its impacts are plastic, and with this friction the feet stick.
# From a faster start the wheel approaches the cycle of the events, with the error of the time step.

# %%
feet = "".join(
    f'<geom type="sphere" size="1e-6" mass="0" pos="{np.sin(a)} 0 {-np.cos(a)}"/>'
    for a in 2 * ALPHA * np.arange(8)
)
wheel = rb.load(
    f"""<mujoco><worldbody><geom type="plane" size="0 0 1"/><body>
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="{J} {J} {J}"/>{feet}</body></worldbody></mujoco>"""
)
wheel = wheel.replace(gravity=jnp.array([G * np.sin(SLOPE), 0.0, -G * np.cos(SLOPE)]))
w = 1.4 * exact
v = jnp.array([w * np.cos(ALPHA), w * np.sin(ALPHA), w])
law = rb.contact.MoreauContact.of(wheel, friction=10.0)
start = rb.State(jnp.array([0.0, np.cos(ALPHA), ALPHA]), v)
path = rb.rollout(wheel, start, None, 1e-3, steps=8000, contact=law)
rates = np.asarray(path.v[:, 2])
falls = np.diff(rates) < -0.02  # in the one or two steps of an impact
strikes = np.flatnonzero(falls[:-1] & ~falls[1:]) + 1
after = rates[strikes]
print("period, last steps  ", np.diff(path.ts[strikes])[-3:], " events", period)
print("rate, last steps    ", after[-3:], " events", exact)

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
left.plot(path.ts, rates)
left.axhline(exact, lw=0.8, color="k", ls="--")
left.set(xlabel="t [s]", ylabel="rate [rad/s]", title="A rimless wheel")
left.plot(path.ts[strikes], after, "o", ms=3)
errors = np.abs(after[:7] - exact)
right.semilogy(errors, "o", label="time stepping")
right.semilogy(errors[0] * ETA ** (2 * np.arange(7)), lw=0.8, label="eigenvalue")
right.set(xlabel="impact", ylabel="error of the rate", title="falls by the eigenvalue")
right.legend()
fig.tight_layout()

# %% [markdown]
# ## The simplest walker
#
# Two massless legs, a mass at the hip, and feet so light that the swing leg does not move the
# stance leg (Garcia, Chatterjee, Ruina & Coleman 1998). The mass matrix of this limit is singular,
# so it is written as its own vector field, a guard and a reset.


# %%
def walk(t, y, slope):
    leg, swing, rate, swing_rate = y
    a = jnp.sin(leg - slope)
    b = a + rate**2 * jnp.sin(swing) - jnp.cos(leg - slope) * jnp.sin(swing)
    return jnp.stack([rate, swing_rate, a, b])


def heel(t, y, slope):
    """Zero at heel strike; the legs also pass each other, near the vertical."""
    return jnp.where(y[0] > -0.1, 1.0, 2 * y[0] - y[1])


def stride(y, slope, ts=None):
    """The state after the next heel strike, and the motion until then."""
    c = jnp.cos(2 * y[0])
    start = jnp.stack([y[0], 2 * y[0], y[1], (1 - c) * y[1]])
    end = integrate_until(walk, start, heel, 6.0, slope, ts=ts, tolerance=1e-12)
    return jnp.stack([-end.y[0], jnp.cos(2 * end.y[0]) * end.y[2]]), end


slope = jnp.asarray(0.009)
gait = rb.stability.limit_cycle(lambda y: stride(y, slope)[0], [0.2, -0.2])
_, steady = stride(gait.state, slope, jnp.linspace(0.0, 4.0, 120))
print("stance angle and rate", np.asarray(gait.state))
print("period", float(steady.t), " eigenvalues", gait.eigenvalues)

# %% [markdown]
# The derivative of the gait by the slope follows from the same Jacobian: y* = P(y*, slope), so
# dy* = (1 - P')^-1 P_slope. It predicts the gait of a neighbouring slope.

# %%
by_slope = jax.jacfwd(lambda s: stride(gait.state, s)[0])(slope)
slope_of_gait = np.linalg.solve(np.eye(2) - gait.jacobian, by_slope)
steeper = rb.stability.limit_cycle(
    lambda y: stride(y, slope + 1e-4)[0], gait.state + 1e-4 * slope_of_gait
)
print("predicted", np.asarray(gait.state + 1e-4 * slope_of_gait))
print("found    ", np.asarray(steeper.state))

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
inside = np.linspace(0.0, 4.0, 120) <= float(steady.t)
left.plot(steady.ys[inside, 0], steady.ys[inside, 2], label="stance leg")
swing = steady.ys[:, 0] - steady.ys[:, 1], steady.ys[:, 2] - steady.ys[:, 3]
left.plot(swing[0][inside], swing[1][inside], label="swing leg")
left.set(xlabel="angle [rad]", ylabel="rate", title="The gait of the simplest walker")
left.legend()
turn = np.linspace(0, 2 * np.pi, 100)
right.plot(np.cos(turn), np.sin(turn), lw=0.8, color="k")
right.plot(gait.eigenvalues.real, gait.eigenvalues.imag, "o")
right.set(aspect="equal", title="Its eigenvalues", xlabel="real", ylabel="imaginary")
fig.tight_layout()

# %% [markdown]
# ## Running on a spring
#
# A point mass on a spring that is a leg without mass: flight, stance, flight. No energy is lost, so
# the height of the apex is the only coordinate of the return map. The same leg has two gaits of one
# energy: one stable by itself, with no control, and one unstable.

# %%
MASS, STIFFNESS, ATTACK = 80.0, 20e3, np.deg2rad(68)
ENERGY = 5.0**2 / 2 + G


def flight(t, y, args):
    return jnp.stack([y[2], y[3], 0.0 * t, 0.0 * t - G])


def stance(t, y, args):
    l = jnp.sqrt(y[0] ** 2 + y[1] ** 2)
    f = STIFFNESS * (1 - l) / (MASS * l)
    return jnp.stack([y[2], y[3], f * y[0], f * y[1] - G])


def apex(y):
    speed = jnp.sqrt(2 * (ENERGY - G * y[0]))
    start = jnp.stack([0.0 * speed, y[0], speed, 0.0 * speed])
    down = integrate_until(flight, start, lambda t, y, _: y[1] - np.sin(ATTACK), 3.0).y
    foot = down.at[0].set(-np.cos(ATTACK))
    up = integrate_until(
        stance, foot, lambda t, y, _: 1 - y[0] ** 2 - y[1] ** 2, 3.0, leaving=True
    ).y
    return integrate_until(flight, up, lambda t, y, _: y[3], 3.0).y[1:2]


for guess in (0.95, 1.33):
    hop = rb.stability.limit_cycle(apex, [guess])
    print(f"apex {hop.state[0]:.10f} m, eigenvalue {hop.eigenvalues[0].real:+.8f}, {hop.stable=}")

# %%
heights = jnp.linspace(0.93, 1.36, 60)
after = jax.jit(jax.vmap(lambda h: apex(h[None])[0]))(heights)
fig, axis = plt.subplots(figsize=(4.5, 3.5))
axis.plot(heights, after, label="return map")
axis.plot(heights, heights, lw=0.8, color="k")
axis.set(xlabel="apex [m]", ylabel="next apex [m]", title="Two gaits of one energy")
fig.tight_layout()
