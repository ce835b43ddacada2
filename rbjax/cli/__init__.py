"""The command line: `rbjax info | simulate | identify | validate | bench | view | train | play |
demo | --version`.

Commands compute in f64, inside `jax.enable_x64`; tasks and policies in f32. A `RbjaxError` prints
one sentence and sets exit code 2. `validate` exits with 1 if a quantity is out of tolerance.

Files:
    session.py: the application and what all commands share.
    files.py: `info`, `simulate`.
    measures.py: `identify`, `validate`, `bench`, `demo`.
    training.py: `train`.
    viewing.py: `view`, `play`.
"""

from rbjax.cli import files, measures, training, viewing
from rbjax.cli.session import app

__all__ = ["app", "files", "main", "measures", "training", "viewing"]


def main() -> None:
    """Run the `rbjax` command."""
    app()
