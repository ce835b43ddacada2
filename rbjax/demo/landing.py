"""A quadruped drops onto the ground: its motion, its contact forces, and the solver's report."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.contact import solve
from rbjax.demo.report import Section
from rbjax.loading import compile_model, load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.plotting import STYLE, Camera, draw, strobe
from rbjax.style import BLUE, INK

#: N m/rad and N m s/rad of the joints
_STIFFNESS, _DAMPING = 80.0, 3.0
#: height above the stance, m, step, s, and number of steps
_DROP, _DT, _STEPS = 0.25, 0.002, 400


def touching(scene: str, part: str = "foot") -> Model:
    """Load a bundled robot of which geoms touch the floor. The geoms of the scene do not.

    part: a part of the names of the geoms that touch; "" for all.
    """
    m = compile_model(scene)
    for k in range(m.ngeom):
        name = m.geom(k).name
        m.geom_conaffinity[k] = name == "floor"
        m.geom_contype[k] = name != "floor" and part in name
    return load(m)


def landing(
    folder: Path, say: Callable[[str], None], *, scene: str = "quadruped", batch: int = 16
) -> Section:
    """Simulate a batch of drops and draw one of them. Return the section of the report."""
    say(f"landing: compiling {batch} x {scene} on the ground")
    model = touching(scene)
    stand = model.keyframe("stand")

    def ctrl(t: jax.Array, state: State) -> jax.Array:
        """Hold the legs in the stance by springs and dampers."""
        return _STIFFNESS * (stand.q[7:] - state.q[7:]) - _DAMPING * state.v[6:]

    noise = 0.3 * np.random.default_rng(0).normal(size=(batch, model.nv))
    q = jnp.broadcast_to(stand.q.at[2].add(_DROP), (batch, model.nq))
    start = State(q, jnp.asarray(noise, q.dtype))
    every = 4

    @jax.jit
    def run(state: State):
        path = rollout(model, state, ctrl, _DT, steps=_STEPS, save_every=every)

        def at(q: jax.Array, v: jax.Array):
            found = solve(model, State(q, v), ctrl)
            own = found.contacts
            up = (own.frame[:, 0, 2] * own.force[:, 0]).sum()
            return up, found.iterations, found.converged, own

        return path, jax.vmap(at)(path.q[0], path.v[0])

    compiled = run.lower(start).compile()
    path, (up, iterations, converged, contacts) = jax.block_until_ready(compiled(start))
    begin = time.perf_counter()
    jax.block_until_ready(compiled(start))
    rate = batch * _STEPS / (time.perf_counter() - begin)
    say(f"landing: drawing {scene}")
    weight = float(model.bodies.mass.sum() * jnp.linalg.norm(model.gravity))
    last = jax.tree.map(lambda x: x[-1], contacts)
    camera = Camera(-80, 10)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
        shown = np.linspace(0, len(path.ts) - 1, 5).astype(int)
        strobe(model, path.q[0][shown], ax=axes[0], source=scene, camera=camera)
        axes[0].set_title("it falls and lands")
        draw(model, path.q[0, -1], ax=axes[1], source=scene, camera=camera, contacts=last)
        axes[1].set_title("contact forces at the end")
        axes[2].plot(path.ts, np.asarray(up) / weight, color=BLUE)
        axes[2].axhline(1.0, color=INK, lw=0.8, ls=":")
        axes[2].set(xlabel="time, s", ylabel="vertical force / weight")
        figure.savefig(folder / "landing.png")
        plt.close(figure)
    done = "all of them converged" if bool(converged.all()) else "NOT all of them converged"
    return Section(
        "Land on the ground",
        (
            "Contacts, limits and friction loss are MuJoCo's convex problem, solved by Newton's "
            "method in each step. Below, one of a batch of quadrupeds that are dropped from "
            f"{100 * _DROP:.0f} cm.",
        ),
        (("landing.png", "A quadruped lands; arrows are the forces of the ground on it."),),
        ("scene", "robots", "steps each", "largest force / weight", "force / weight at the end",
         "Newton steps, mean and most", "steps a second (this machine)"),
        ((
            scene, f"{batch}", f"{_STEPS}", f"{float(up.max()) / weight:.1f}",
            f"{float(up[-1]) / weight:.2f}",
            f"{float(iterations.mean()):.1f}, {int(iterations.max())}", f"{rate:,.0f}",
        ),),
        note=f"The solver's report is of {len(path.ts)} saved states, and {done}.",
        code="model = rb.load('robot.xml', contacts=True)\n"
        "path = rb.rollout(model, state, policy, 0.002, steps=400)\n"
        "rb.contact.solve(model, path.state(-1)).contacts.force",
    )  # fmt: skip
