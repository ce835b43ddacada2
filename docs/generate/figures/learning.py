"""Tasks on a GPU, and training."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure

FIGURES: dict[str, Figure] = {}
