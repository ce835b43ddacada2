"""What all commands share: the application, arguments, f64, errors in one sentence, progress."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Iterator
from typing import Annotated, Any

import jax
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

import rbjax as rb
from rbjax.errors import RbjaxError

app = typer.Typer(add_completion=False, no_args_is_help=True)
out, err = Console(), Console(stderr=True)

File = Annotated[str, typer.Argument(help="MJCF or URDF file, or a bundled scene's name.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Floating = Annotated[bool, typer.Option("--floating-base", help="Free a URDF's root link.")]


@contextlib.contextmanager
def session(*, double: bool = True) -> Iterator[None]:
    """Run a command in f64, or in f32 if not double.

    Print a `RbjaxError` and exit with code 2. Hide known warnings.
    """
    with warnings.catch_warnings(), jax.enable_x64(double):
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
def progress(*, log: bool = False) -> Iterator[Any]:
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
