"""Commands that show robots: `view` and `play`, in the browser or as a file."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

import rbjax as rb
from rbjax.cli.session import Floating, app, out, progress, session

Samples = Annotated[int, typer.Option(help="Number of robots; all but the first are ghosts.")]
Seconds = Annotated[float | None, typer.Option(help="How long; one episode if not given.")]
Seed = Annotated[int, typer.Option(help="Of the random numbers.")]
Save = Annotated[
    Path | None, typer.Option("--out", help="Write a page (.html), a .gif or an .mp4 instead.")
]
Host = Annotated[str, typer.Option(help="Address of the server; 0.0.0.0: for other machines too.")]
Port = Annotated[int, typer.Option(help="Port of the server, or the next free one.")]
Browser = Annotated[bool, typer.Option(help="Open a browser.")]


@app.command()
def view(
    what: Annotated[
        str, typer.Argument(help="Robot file or scene, trajectory (.npz), or name of a task.")
    ],
    samples: Samples = 1,
    seconds: Seconds = None,
    seed: Seed = 0,
    save: Save = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    browser: Browser = True,
    floating_base: Floating = False,
) -> None:
    """Show a robot with joint sliders, a trajectory, or a task with random actions."""
    task = what in rb.envs.tasks()
    with session(double=not task):
        _check(save)
        from rbjax.viewer import motion_of

        with progress() as (say, _):
            say(f"compiling and running {what}" if task else f"reading {Path(what).name}")
            motion = motion_of(
                what, floating_base=floating_base, samples=samples, seconds=seconds, seed=seed
            )
        _show(motion, save, host, port, browser)


@app.command()
def play(
    checkpoint: Annotated[Path, typer.Argument(help="Folder that `rbjax train` has written.")],
    samples: Samples = 1,
    seconds: Seconds = None,
    seed: Seed = 0,
    save: Save = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    browser: Browser = True,
) -> None:
    """Show a trained policy in its task."""
    with session(double=False):
        _check(save)
        from rbjax.envs.learning import load_policy
        from rbjax.viewer import motion_of_policy

        with progress() as (say, _):
            say(f"compiling and running {checkpoint.name}")
            env, policy = load_policy(checkpoint)
            motion = motion_of_policy(env, policy, samples=samples, seconds=seconds, seed=seed)
        _show(motion, save, host, port, browser)


def _check(save: Path | None) -> None:
    """Check `save`, or that viser is installed, before the motion is computed."""
    from rbjax.plotting.animation import writable
    from rbjax.viewer.viewing import check_viser

    if save is None:
        check_viser()
    else:
        writable(save)


def _show(motion: Any, save: Path | None, host: str, port: int, browser: bool) -> None:
    if save is not None:
        motion.animate(save)
        out.print(f"[green]wrote[/] [bold]{escape(str(save))}[/]", soft_wrap=True)
        return
    viewer = motion.view(host=host, port=port)
    out.print(f"[bold]{viewer.url}[/]; Ctrl-C ends it", soft_wrap=True)
    if browser:
        webbrowser.open(viewer.url)
    viewer.wait()
