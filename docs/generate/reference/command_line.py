"""The page of the command line, from the help of each command."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from unittest import mock

import typer
from typer.testing import CliRunner

from docs.generate import tree
from rbjax.cli import app

WIDTH = 88


def pages(root: Path) -> tree.Pages:
    """The page: `rbjax --help`, then the help of each command."""
    lines = [
        "# Command line", "",
        "`rbjax COMMAND --help` shows the help of a command. `python -m rbjax` is the same as "
        "`rbjax`. A wrong argument or file prints one sentence, and the exit code is 2.", "",
        "```text", help_of(), "```", "",
    ]  # fmt: skip
    for name in commands():
        lines += [f"## rbjax {name}", "", "```text", help_of(name), "```", ""]
    return {"reference/command_line.md": "\n".join(lines)}


def commands() -> list[str]:
    """Names of the commands, in the order of the help."""
    return list(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


def help_of(*command: str) -> str:
    """The help of the program or of a command as plain text."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch("typer.rich_utils.MAX_WIDTH", WIDTH))
        stack.enter_context(mock.patch("typer.rich_utils.COLOR_SYSTEM", None))
        stack.enter_context(mock.patch("typer.rich_utils.FORCE_TERMINAL", False))
        result = CliRunner().invoke(app, [*command, "--help"], prog_name="rbjax")
    text = re.sub(r"\x1b\[[0-9;]*m", "", result.output)
    return "\n".join(line.rstrip() for line in text.strip("\n").split("\n"))
