"""Commands on a robot file: `info` and `simulate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import typer
from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

import rbjax as rb
from rbjax.cli.session import AsJson, File, Floating, app, out, progress, session
from rbjax.dynamics.tracing.operations import OperationCount, operation_count
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.optional import require


def operations(model: Model) -> dict[str, OperationCount]:
    """Count the traced operations of each algorithm, for a model as a compile-time constant.

    Example:
        >>> import rbjax as rb
        >>> operations(rb.load("pendulum"))["mass matrix (CRBA)"].total
        0
    """
    q, v = model.joints.reference, jnp.zeros(model.nv, model.joints.reference.dtype)
    if not model.nv:
        return {}
    calls: dict[str, tuple[Any, ...]] = {
        "forward kinematics": (rb.forward_kinematics, q),
        "inverse dynamics (RNEA)": (rb.inverse_dynamics, q, v, v),
        "bias forces": (rb.bias_forces, q, v),
        "gravity forces": (rb.gravity_forces, q),
        "mass matrix (CRBA)": (rb.mass_matrix, q),
        "forward dynamics (ABA)": (rb.forward_dynamics, q, v, v),
    }
    return {name: operation_count(fn, model, *args) for name, (fn, *args) in calls.items()}


@app.command()
def info(file: File, as_json: AsJson = False, floating_base: Floating = False) -> None:
    """Show a robot file: its tree, the features left out, the operations of each algorithm."""
    with session():
        model = rb.load(file, floating_base=floating_base or None)
        counts = operations(model)
    if as_json:
        found: dict[str, Any] = {"nq": model.nq, "nv": model.nv, "nu": model.nu, "nb": model.nb}
        found |= {"timestep": model.timestep, "mass": float(np.asarray(model.bodies.mass).sum())}
        for kind in ("body", "joint", "actuator", "site", "keyframe"):
            found[f"{kind}_names"] = list(getattr(model, f"{kind}_names"))
        found["dropped"] = list(model.dropped)
        found["operations"] = {n: vars(c) | {"total": c.total} for n, c in counts.items()}
        print(json.dumps(found, indent=1))
        return
    out.print(_tree(model, file))
    for dropped in model.dropped:
        out.print(f"[yellow]left out:[/] {escape(str(dropped))}", highlight=False)
    table = Table(title="Operations of one evaluation, as traced", title_justify="left")
    table.add_column("algorithm", no_wrap=True)
    heads = ("add", "multiply", "divide", "root", "trig", "total")
    kinds = ("additions", "multiplications", "divisions", "roots", "trigonometry", "total")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    for name, count in counts.items():
        table.add_row(name, *(f"{getattr(count, kind):,}" for kind in kinds))
    out.print(table)


def _tree(model: Model, file: str) -> Tree:
    """Make the tree of bodies with their joints."""
    top, mass = model.topology, np.asarray(model.bodies.mass)
    head = f"[bold]{escape(Path(file).name)}[/]: {model.nb} bodies, nq {model.nq}, nv {model.nv}, "
    tree = Tree(head + f"nu {model.nu}, {mass.sum():.4g} kg, step {model.timestep:g} s")
    branches: dict[int, Tree] = {-1: tree}
    for body, (parent, name) in enumerate(zip(top.body_parents, top.body_names, strict=True)):
        joints = [
            f"{top.joint_names[j]} ({kind})"
            for j, kind in enumerate(top.joint_kinds)
            if top.joint_bodies[j] == body
        ]
        moved = escape(", ".join(joints)) or "welded"
        label = f"{escape(name)}  [dim]{mass[body]:.4g} kg[/]  [cyan]{moved}[/]"
        branches[body] = branches[parent].add(label)
    return tree


FIXED = ("semi_implicit_euler", "rk4", "dop853")
SOLVERS = ("tsit5", "dopri5", "dopri8", *FIXED)


@app.command()
def simulate(
    file: File,
    seconds: Annotated[float, typer.Option(help="How long.")] = 2.0,
    solver: Annotated[str, typer.Option(help=f"One of {', '.join(SOLVERS)}.")] = "tsit5",
    dt: Annotated[float | None, typer.Option(help="Step in seconds, for fixed steps.")] = None,
    keyframe: Annotated[str | None, typer.Option(help="Start from this state of the file.")] = None,
    save: Annotated[
        Path | None, typer.Option("--out", help="Write the trajectory to this .npz.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw to this .png.")] = None,
    video: Annotated[Path | None, typer.Option(help="Animate to .gif, .html or .mp4.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second of the video.")] = 25.0,
    as_json: AsJson = False,
    floating_base: Floating = False,
) -> None:
    """Simulate a robot, without controls except those of the keyframe."""
    with session(), progress() as (say, advance):
        model = rb.load(file, floating_base=floating_base)
        if video is not None:
            from rbjax.plotting.animation import writable

            writable(video)
        say("compiling and simulating")
        path = _simulate(model, seconds, solver, dt, keyframe)
        arrays: dict[str, Any] = {n: np.asarray(getattr(path, n)) for n in ("ts", "q", "v")}
        if save is not None:
            rb.loading.save_trajectory(save, model, path, source=file)
        if plot is not None:
            say("drawing")
            _plot(plot, file, model, arrays, floating_base)
        if video is not None:
            say(f"drawing {video.name}")
            rb.plotting.animate(
                model, path, video, source=file, floating_base=floating_base, fps=fps,
                title=Path(file).stem, progress=lambda done, total: advance(1.0, total),
            )  # fmt: skip
        energy = [
            float(rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q))
            for q, v in ((path.q[0], path.v[0]), (path.q[-1], path.v[-1]))
        ]
    found = {
        "seconds": seconds,
        "states": len(arrays["ts"]),
        "success": bool(path.success),
        "energy": energy,
    }
    found |= {"q": arrays["q"][-1].tolist(), "v": arrays["v"][-1].tolist()}
    if as_json:
        print(json.dumps(found, indent=1))
        return
    for name, value in found.items():
        out.print(f"[bold]{name}[/] {escape(str(value))}", soft_wrap=True)


def _simulate(
    model: Model, seconds: float, solver: str, dt: float | None, keyframe: str | None
) -> rb.Trajectory:
    import diffrax

    if solver not in SOLVERS:
        raise InputError(f"solver {solver!r}, expected one of {', '.join(SOLVERS)}")
    if not seconds > 0:
        raise InputError(f"seconds is {seconds}, expected more than 0")
    state, ctrl = model.default_state(), jnp.zeros(model.nu)
    if keyframe is not None:
        state = model.keyframe(keyframe)
        ctrl = model.keyframes.ctrl[model.keyframe_names.index(keyframe)]
    if solver in FIXED:
        step = model.timestep if dt is None else dt
        steps = max(1, round(seconds / step))
        ctrls = jnp.broadcast_to(ctrl, (steps, model.nu))
        return rb.rollout(model, state, ctrls, step, integrator=solver)
    solvers = {"tsit5": diffrax.Tsit5, "dopri5": diffrax.Dopri5, "dopri8": diffrax.Dopri8}
    ts = jnp.linspace(0.0, seconds, max(2, round(100 * seconds) + 1))
    return rb.simulate(model, state, ts, lambda t, state: ctrl, solver=solvers[solver](), dt=dt)


def _plot(
    path: Path, file: str, model: Model, arrays: dict[str, np.ndarray], floating_base: bool
) -> None:
    require("--plot", "matplotlib").use("Agg")
    plt = require("--plot", "matplotlib.pyplot")
    from rbjax.plotting import STYLE, strobe, time_plot

    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(11, 5.4), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.3))
        ax = figure.add_subplot(grid[:, 0])
        moments = np.linspace(0, len(arrays["ts"]) - 1, 7).astype(int)
        strobe(model, arrays["q"][moments], ax=ax, source=file, floating_base=floating_base)
        ax.set_title(Path(file).stem)
        axes = [figure.add_subplot(grid[i, 1]) for i in range(2)]
        names = model.joint_names if model.nq == len(model.joint_names) else ()
        few = names if len(names) <= 8 else ()
        time_plot(arrays["ts"], arrays["q"], arrays["v"], names=few, ax=axes)
        figure.savefig(path)
        plt.close(figure)
