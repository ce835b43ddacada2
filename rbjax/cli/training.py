"""The command `train`: a policy for a task."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from rbjax.cli.session import app, err, out
from rbjax.errors import RbjaxError


@app.command()
def train(
    task: Annotated[str, typer.Argument(help="Name of a task, such as go1_joystick_flat.")],
    algorithm: Annotated[str, typer.Option(help="ppo, or shac (by gradients).")] = "ppo",
    steps: Annotated[int | None, typer.Option(help="Steps of the robot in all.")] = None,
    folder: Annotated[Path | None, typer.Option("--out", help="Folder of the results.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    devices: Annotated[int | None, typer.Option(help="Number of devices.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Limit of time.")] = None,
) -> None:
    """Train a policy for a task. Writes a checkpoint, a table and a chart.

    In f32, unlike the other commands.
    """
    from rbjax.envs.learning import train as run

    place = Path(f"{task}-{algorithm}") if folder is None else folder
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*left out of the model")
        try:
            run(
                task, algorithm, steps=steps, out=place, seed=seed, devices=devices,
                seconds=seconds,
            )  # fmt: skip
        except RbjaxError as error:
            err.print("[bold red]rbjax:[/]", escape(str(error)), highlight=False, soft_wrap=True)
            raise typer.Exit(2) from None
    written = {"checkpoint": "policy.json", "table": "table.csv", "chart": "chart.png"}
    for what, name in written.items():
        out.print(f"[bold]{what}[/] {escape(str(place / name))}", soft_wrap=True)
    out.print(f"[bold]next[/] rbjax play {escape(str(place))}", soft_wrap=True)
