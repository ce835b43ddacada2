"""`python -m rbjax` and `rbjax`: the command line."""

import sys

from rbjax.errors import MissingPackage
from rbjax.optional import require


def main() -> None:
    """Run the `rbjax` command. Without the extra `cli`, print one sentence and exit with code 2."""
    try:
        for package in ("typer", "rich"):
            require("rbjax", package)
    except MissingPackage as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    from rbjax.cli import app

    app(prog_name="rbjax")


if __name__ == "__main__":
    main()
