"""Errors of beams in strain coordinates and of Exudyn's."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Number

EXUDYN = "flexible-exudyn-amd-epyc"
FIGURES: dict[str, Figure] = {
    "beams.elastica": Number(
        EXUDYN, "error", {"formulation": "strain coordinates", "coordinates": 8}, digits=1
    ),
    "beams.elastica.exudyn": Number(
        EXUDYN, "error", {"formulation": "Exudyn GE beam 2D", "coordinates": 96}, digits=1
    ),
}
