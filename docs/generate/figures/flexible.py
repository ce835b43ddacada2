"""Errors of beams in strain coordinates and of Exudyn's."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Number

EXUDYN = "flexible-exudyn-amd-epyc"
BEND = "flexible-reduced-bend-amd-epyc"
#: from loads in one direction, of a thick arc; from loads in four directions, of every slenderness
ONE = {"slenderness": 10.0, "snapshots": "one direction", "coordinates": 6}
FOUR = {"snapshots": "four directions", "coordinates": 16}
FIGURES: dict[str, Figure] = {
    "beams.elastica": Number(
        EXUDYN, "error", {"formulation": "strain coordinates", "coordinates": 8}, digits=1
    ),
    "beams.elastica.exudyn": Number(
        EXUDYN, "error", {"formulation": "Exudyn GE beam 2D", "coordinates": 96}, digits=1
    ),
    "beams.reduced.one": Number(BEND, "error", ONE, digits=1),
    "beams.reduced.one.others": Number(BEND, "within 30 degrees", ONE, digits=2),
    "beams.reduced.four.others": Number(BEND, "within 30 degrees", FOUR, digits=2),
}
