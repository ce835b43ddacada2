"""What each benchmark page shows: tables by name. One file a group of subjects."""

from docs.generate.subjects import (
    accuracy,
    beams,
    control,
    identification,
    learning,
    motion,
    one_core,
    solvers,
)

TABLES = (
    motion.TABLES
    | one_core.TABLES
    | accuracy.TABLES
    | beams.TABLES
    | learning.TABLES
    | control.TABLES
    | identification.TABLES
    | solvers.TABLES
)
