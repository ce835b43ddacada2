"""Beams in strain coordinates beside Exudyn's."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure

FIGURES: dict[str, Figure] = {}
