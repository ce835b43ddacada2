"""Commands that fit, compare, measure and show: `identify`, `validate`, `bench`, `demo`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

import rbjax as rb
from rbjax.cli.session import AsJson, File, Floating, app, out, progress, session
from rbjax.model import Model


@app.command()
def identify(
    configuration: Annotated[Path, typer.Argument(help="TOML file, or a folder for --example.")],
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the saved fit.")] = False,
    example: Annotated[bool, typer.Option("--example", help="Write an example here.")] = False,
    folder: Annotated[Path | None, typer.Option("--out", help="Folder of the results.")] = None,
) -> None:
    """Fit a robot's parameters to recordings. Writes a report, and the fitted robot's file."""
    from rbjax.sysid.jobs.example import write_example
    from rbjax.sysid.jobs.job import Job

    with session():
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

    with session(), progress() as (say, _):
        report = compare(
            file, states=states, mjx=mjx, gradient=gradient, contacts=contacts,
            floating_base=floating_base,
            progress=lambda stage: say(f"{Path(file).name}: {stage}"),
        )  # fmt: skip
    if as_json:
        print(json.dumps(report.to_dict(), indent=1))
    else:
        out.print(report.table())
        within, out_of = "[green]within tolerance[/]", "[bold red]out of tolerance[/]"
        verdict = within if report.success else out_of
        out.print(f"rbjax is {verdict}.")
    if not report.success:
        raise typer.Exit(1)


@app.command()
def bench(
    file: Annotated[str, typer.Argument(help="MJCF or URDF file, or a scene's name.")] = "arm7",
    batch: Annotated[int, typer.Option(help="States at once.")] = 1024,
    as_json: AsJson = False,
) -> None:
    """Time forward dynamics against MuJoCo C on this machine (all measurements: `make bench`)."""
    from rbjax.validation.reference import forward_seconds, random_samples, smooth

    with session(), progress() as (say, _):
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
    with session(), progress(log=True) as (say, advance):
        advance(0.0, total)
        done = lambda name, share: advance(share, total)  # noqa: E731
        report = run(folder, say=say, done=done, everything=everything)
    out.print(f"[green]done[/] in {time.perf_counter() - begin:.0f} s: open [bold]{report}[/]")
