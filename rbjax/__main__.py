"""`python -m rbjax`: the command line."""

from rbjax.cli import main

main()
