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
# # Choosing a solver
#
# `rb.solvers.all()` lists 55 of them. The best solver and step depend on the robot: how stiff it
# is, how long it runs, and how accurate the result must be. This notebook uses linear theory, then
# one robot, then runs that are built to fail, and at the end the function that does all of this.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)
lab = rb.stability

# %% [markdown]
# ## Linear theory
# On $y' = \lambda y$ a step multiplies $y$ by $R(h\lambda)$, a rational function.
# `linear_analysis` finds it exactly, from the coefficients of any method.

# %%
names = ("rk4", "adams_bashforth3", "implicit_midpoint", "radau_iia3", "bdf2", "bdf5")
print(f"{'method':18} {'order':>5} {'constant':>9} {'real':>7} {'imag':>6} {'alpha':>6} L-stable")
for name in names:
    a = lab.linear_analysis(name)
    print(f"{name:18} {a.order:5} {a.error_constant!s:>9} {a.real_limit:7.2f} "
          f"{a.imaginary_limit:6.2f} {a.alpha:6.1f} {a.L_stable}")  # fmt: skip
print(lab.stability_function("radau_iia3"))

# %%
figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.4))
explicit = {"Euler": "euler", "Heun": "heun", "RK4": "rk4", "AB3": "adams_bashforth3"}
lab.plot_regions(explicit, points=201, ax=axes[0])
axes[0].set_title("explicit: stable inside")
stiff = {"BDF2": "bdf2", "BDF3": "bdf3", "BDF5": "bdf5"}
lab.plot_regions(stiff, window=(-5, 20, -12, 12), points=201, ax=axes[1])
axes[1].set_title("BDF: stable outside")
damped = {f"rho = {r}": rb.solvers.generalized_alpha(r) for r in (0.0, 0.5, 0.9)}
lab.plot_spectral_radius(damped, np.geomspace(1e-2, 1e3, 60), ax=axes[2])
axes[2].set_title("generalized-alpha")
figure.tight_layout()

# %% [markdown]
# ## One robot
# A double pendulum whose elbow has a spring of $10^6$ N m/rad. Its linearised motion has a slow
# mode, from gravity, and a fast one, from the spring. The fast mode limits explicit methods to
# short steps on the whole motion. The prediction uses only the eigenvalues. The measurement uses
# runs that grow or do not.

# %%
model = rb.load("double_pendulum")
stiff = model.replace(joints=model.joints.replace(stiffness=jnp.array([0.0, 1e6])))
rest = lab.equilibrium(stiff, stiff.default_state())
A = lab.motion_matrices(stiff, rb.State(rest.q[None], rest.v[None]))
print("eigenvalues", np.sort_complex(np.linalg.eigvals(A[0])).round(3))
for method in ("rollout rk4", "stoermer_verlet"):
    step = lab.stable_step(method.removeprefix("rollout "), A)
    print(f"{method:16} stable to {step * 1e3:.3f} ms", end="")
    if method.startswith("rollout"):
        found = lab.measured_stable_step(method, stiff, rest, near=step, steps=1000)
        print(f", measured {found * 1e3:.3f} ms", end="")
    print()

# %% [markdown]
# ## Conservation and drift
# The energy of a pendulum without friction over twenty thousand steps of 0.1 s. A method can be
# more accurate and still drift; a symplectic one stays within a band. `trend` decides by the slope
# and its error.

# %%
pendulum = rb.load("pendulum")
pendulum = pendulum.replace(joints=pendulum.joints.replace(damping=jnp.zeros(1)))
start = rb.State(jnp.array([2.0]), jnp.zeros(1))
figure, axis = plt.subplots(figsize=(8, 3))
for name in ("rk4", "implicit_midpoint", "yoshida4"):
    solver = rb.solvers.all()[name].make()
    run = lab.drift(pendulum, start, solver=solver, dt=0.1, steps=20_000)
    error = np.abs(run.kept["energy"] / run.kept["energy"][0] - 1)
    drifts = lab.trend(run.ts, run.kept["energy"]).drifts
    axis.semilogy(run.ts[1:], error[1:], lw=0.8, label=f"{name}: {'drifts' if drifts else 'stays'}")
axis.set(xlabel="time [s]", ylabel="energy error, relative", title="pendulum, 0.1 s a step")
axis.legend(loc="lower right")
figure.tight_layout()

# %% [markdown]
# ## How long a gradient lasts
# A double pendulum is chaotic. Neighbouring motions separate at the rate of the Lyapunov exponent,
# and the derivative of the end by the start grows at the same rate. When its norm reaches one over
# the machine's precision, a gradient through the motion is noise.

# %%
wild = rb.State(jnp.array([2.0, 2.4]), jnp.zeros(2))
exponent = lab.lyapunov(model, wild, dt=0.01, steps=20_000)
growth = lab.gradient_growth(model, wild, dt=0.01, steps=4_000)
print(f"Lyapunov exponent {exponent.value:.2f} +- {exponent.error:.2f} 1/s; gradients last "
      f"{growth.f32:.1f} s in f32, {growth.f64:.1f} s in f64")  # fmt: skip

# %% [markdown]
# ## How solvers fail
# Fifteen scenes are built to break solvers. `attempt` runs one and returns the outcome with a
# number: an error, the time of a blow-up, the distance from the manifold, a drift. `make
# failure-map` does this for every solver (`docs/benchmarks/figures/failure_map.png`).

# %%
scenes = lab.scenes()
for scene in ("spring_1e2", "damping"):
    for name in ("rk4", "radau_iia2"):
        v = lab.attempt(rb.solvers.all()[name].make(), scenes[scene])
        print(f"{scenes[scene].title:36} {name:20} {v.outcome.value:14} {v.value:.1e}")

# %% [markdown]
# ## The short way
# `recommend` linearises the motion, runs the candidates and fits their errors, for your robot and
# state. It returns the deciding reason.

# %%
choice = rb.recommend.solver(stiff, rb.State(jnp.array([0.5, 0.0]), jnp.zeros(2)), 1e-4)
print(choice.name, f"with steps of {choice.dt:.3g} s")
print(choice.reason)
path = rb.simulate(
    stiff, rb.State(jnp.array([0.5, 0.0]), jnp.zeros(2)), jnp.linspace(0, 1, 101),
    solver=choice.solver, dt=choice.dt,
)  # fmt: skip

figure, axis = plt.subplots(figsize=(8, 2.8))
axis.plot(path.ts, np.rad2deg(path.q[:, 0]), label="shoulder")
axis.plot(path.ts, 1e5 * np.rad2deg(path.q[:, 1]), label="elbow, times 100,000")
axis.set(xlabel="time [s]", ylabel="deg", title=f"{choice.name}, {choice.dt * 1e3:.0f} ms a step")
axis.legend()
figure.tight_layout()
