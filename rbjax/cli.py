"""The command line: `rbjax info | simulate | identify | validate | bench | demo | --version`.

Commands compute in f64, inside `jax.enable_x64`. A `RbjaxError` prints one sentence and sets exit
code 2. `validate` exits with 1 if a quantity is out of tolerance.
"""

from __future__ import annotations

import contextlib
import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.tree import Tree

import rbjax as rb
from rbjax.dynamics.tracing.operations import OperationCount, operation_count
from rbjax.errors import InputError, RbjaxError
from rbjax.model import Model

app = typer.Typer(add_completion=False, no_args_is_help=True)
out, err = Console(), Console(stderr=True)

File = Annotated[str, typer.Argument(help="MJCF or URDF file, or a bundled scene's name.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Floating = Annotated[bool, typer.Option("--floating-base", help="Free a URDF's root link.")]


@contextlib.contextmanager
def _session() -> Iterator[None]:
    """Run a command in f64. Print a `RbjaxError` and exit with code 2. Hide known warnings."""
    with warnings.catch_warnings(), jax.enable_x64(True):
        warnings.filterwarnings("ignore", message=".*left out of the model")
        try:
            yield
        except RbjaxError as error:
            err.print("[bold red]rbjax:[/]", escape(str(error)), highlight=False, soft_wrap=True)
            raise typer.Exit(2) from None


def _version(asked: bool) -> None:
    if asked:
        print(f"rbjax {rb.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Differentiable rigid-body dynamics in JAX."""


@contextlib.contextmanager
def _progress(*, log: bool = False) -> Iterator[Any]:
    """Show a spinner on stderr. Yield say(text), and advance(done, total) for its bar.

    log: whether each text is printed as a line if stderr is not a terminal.
    """
    if log and not err.is_terminal:
        begin = time.perf_counter()

        def line(text: str) -> None:
            spent = f"{time.perf_counter() - begin:4.0f} s  "
            err.print(spent + text, highlight=False, markup=False, soft_wrap=True)

        yield line, lambda done, total: None
        return
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task("", total=None)

        def say(text: str) -> None:
            bar.update(task, description=text)

        def advance(done: float, total: float) -> None:
            bar.update(task, advance=done, total=total)

        yield say, advance


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
    with _session():
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
    save: Annotated[Path | None, typer.Option("--out", help="Write ts, q, v to this .npz.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw to this .png.")] = None,
    video: Annotated[Path | None, typer.Option(help="Animate to .gif, .html or .mp4.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second of the video.")] = 25.0,
    as_json: AsJson = False,
    floating_base: Floating = False,
) -> None:
    """Simulate a robot, without controls except those of the keyframe."""
    with _session(), _progress() as (say, advance):
        model = rb.load(file, floating_base=floating_base)
        if video is not None:
            from rbjax.plotting.animation import writable

            writable(video)
        say("compiling and simulating")
        path = _simulate(model, seconds, solver, dt, keyframe)
        arrays: dict[str, Any] = {n: np.asarray(getattr(path, n)) for n in ("ts", "q", "v")}
        if save is not None:
            np.savez(save, **arrays)
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
    found = {"seconds": seconds, "states": len(arrays["ts"]), "ok": bool(path.ok), "energy": energy}
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
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from rbjax.plotting import STYLE, strobe, time_plot

    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(11, 5.4), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.3))
        ax = figure.add_subplot(grid[:, 0])
        moments = np.linspace(0, len(arrays["ts"]) - 1, 7).astype(int)
        strobe(ax, file, model, arrays["q"][moments], floating_base=floating_base)
        ax.set_title(Path(file).stem)
        axes = [figure.add_subplot(grid[i, 1]) for i in range(2)]
        names = model.joint_names if model.nq == len(model.joint_names) else ()
        time_plot(axes, arrays["ts"], arrays["q"], arrays["v"], names)
        if 0 < len(names) <= 8:
            axes[0].legend(loc="upper right", ncols=2)
        figure.savefig(path)
        plt.close(figure)


@app.command()
def identify(
    configuration: Annotated[Path, typer.Argument(help="TOML file, or a folder for --example.")],
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the saved fit.")] = False,
    example: Annotated[bool, typer.Option("--example", help="Write an example here.")] = False,
    folder: Annotated[Path | None, typer.Option("--out", help="Folder of the results.")] = None,
) -> None:
    """Fit a robot's parameters to recordings. Writes a report, and the robot's file with the
    fitted parameters."""
    from rbjax.sysid.jobs.example import write_example
    from rbjax.sysid.jobs.job import Job

    with _session():
        if example:
            written = write_example(configuration)
            text = f"wrote {written}; run: rbjax identify {written}"
            out.print(text, soft_wrap=True, markup=False)
            return
        made = Job.read(configuration, folder=folder).run(resume=resume, progress=True)
        intervals = {name: made.found.estimates.interval(name) for name in made.found.values}
    ended = f"{made.found.status.text} in {made.found.evaluations} evaluations"
    table = Table("parameter", title=ended, title_justify="left")
    for head in ("first guess", "found", "95 % from", "to"):
        table.add_column(head, justify="right")
    for name, x in intervals.items():
        numbers = (made.found.guess[name], x.value, x.low, x.high)
        table.add_row(escape(name), *(f"{number:.5g}" for number in numbers))
    out.print(table)
    verdict = made.verdict.summary() if made.verdict else "no recording was held out"
    for sentence in (verdict, *map(str, made.diagnosis.causes), *made.notes):
        out.print(sentence, soft_wrap=True, highlight=False, markup=False)
    for what, path in made.files.items():
        out.print(f"[bold]{what}[/] {escape(str(path))}", soft_wrap=True)
    if not made.found.success:
        raise typer.Exit(1)


@app.command()
def validate(
    file: File,
    as_json: AsJson = False,
    states: Annotated[int, typer.Option(help="Random states.")] = 20,
    mjx: Annotated[bool, typer.Option(help="Run MJX too.")] = True,
    gradient: Annotated[bool, typer.Option(help="Compare gradients too.")] = True,
    contacts: Annotated[bool, typer.Option("--contacts", help="Compare contacts too.")] = False,
    floating_base: Floating = False,
) -> None:
    """Compare a robot with MuJoCo C and MJX; exit code 1 when rbjax is out of tolerance."""
    from rbjax.validation import compare

    with _session(), _progress() as (say, _):
        report = compare(
            file, states=states, mjx=mjx, gradient=gradient, contacts=contacts,
            floating_base=floating_base,
            progress=lambda stage: say(f"{Path(file).name}: {stage}"),
        )  # fmt: skip
    if as_json:
        print(json.dumps(report.to_dict(), indent=1))
    else:
        out.print(report.table())
        verdict = "[green]within tolerance[/]" if report.ok else "[bold red]out of tolerance[/]"
        out.print(f"rbjax is {verdict}.")
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def bench(
    file: Annotated[str, typer.Argument(help="MJCF or URDF file, or a scene's name.")] = "arm7",
    batch: Annotated[int, typer.Option(help="States at once.")] = 1024,
    as_json: AsJson = False,
) -> None:
    """Time forward dynamics against MuJoCo C on this machine (all measurements: `make bench`)."""
    from rbjax.validation.reference import forward_seconds, random_samples, smooth

    with _session(), _progress() as (say, _):
        reference, _ = smooth(file)
        samples = random_samples(reference, batch, 0)
        rows = {"MuJoCo C, f64, one thread": forward_seconds(reference, samples)}
        for dtype in (jnp.float32, jnp.float64):
            name = jnp.dtype(dtype).name.replace("float", "f")
            say(f"compiling forward dynamics in {name}")
            rows[f"rbjax, {name}"] = _forward_seconds(rb.load(file), samples, dtype)
    micro = {name: 1e6 * seconds / batch for name, seconds in rows.items()}
    device = jax.devices()[0].device_kind
    if as_json:
        print(json.dumps({"file": file, "batch": batch, "device": device, "us": micro}, indent=1))
        return
    table = Table("engine", title=f"forward dynamics of {Path(file).name}, batch {batch}, {device}")
    table.add_column("us per evaluation", justify="right")
    for name, value in micro.items():
        table.add_row(name, f"{value:.3g}")
    out.print(table)
    out.print("MuJoCo runs a full mj_forward. All figures: [bold]make bench[/] in a checkout.")


def _forward_seconds(model: Model, samples: Any, dtype: Any) -> float:
    from rbjax.model.record import cast_floats

    model, q, v = cast_floats((model, samples.q, samples.v), dtype)
    run = jax.jit(jax.vmap(rb.forward_dynamics, (None, 0, 0, 0)))
    jax.block_until_ready(run(model, q, v, v))
    times = []
    for _ in range(20):
        begin = time.perf_counter()
        jax.block_until_ready(run(model, q, v, v))
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


@app.command()
def demo(
    folder: Annotated[Path, typer.Option("--out", help="Where to.")] = Path("rbjax-demo"),
    everything: Annotated[bool, typer.Option("--all", help="Also the long parts.")] = False,
) -> None:
    """Run rbjax on bundled scenes: pictures and a report in ./rbjax-demo/, in two minutes."""
    from rbjax.demo import demo as run
    from rbjax.demo.run import PARTS, SHORT

    total = sum(share for name, (_, share) in PARTS.items() if everything or name in SHORT)
    begin = time.perf_counter()
    with _session(), _progress(log=True) as (say, advance):
        advance(0.0, total)
        done = lambda name, share: advance(share, total)  # noqa: E731
        report = run(folder, say=say, done=done, everything=everything)
    out.print(f"[green]done[/] in {time.perf_counter() - begin:.0f} s: open [bold]{report}[/]")


def main() -> None:
    """Run the `rbjax` command."""
    app()


if __name__ == "__main__":
    main()
