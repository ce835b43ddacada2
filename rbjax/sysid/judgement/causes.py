"""The result of `diagnose`: mistakes in recordings."""

from __future__ import annotations

from dataclasses import dataclass

from rbjax.display import displayed
from rbjax.sysid.data.recording import Recording


@displayed
@dataclass(frozen=True)
class Cause:
    """One mistake in the recordings.

    Fields:
        kind: "sign", "swap", "clock", "outliers" or "dead".
        channels, columns: names of the affected channels and columns.
        before, after: error without and with the correction.
        sentence: description for users.
    """

    kind: str
    channels: tuple[str, ...]
    columns: tuple[str, ...]
    before: float
    after: float
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@displayed
@dataclass(frozen=True)
class Diagnosis:
    """The mistakes in the recordings of a fit.

    Fields:
        causes: the mistakes, sorted by the reduction of the error.
        recordings: the recordings with all corrections.
    """

    causes: tuple[Cause, ...]
    recordings: tuple[Recording, ...]

    def summary(self) -> str:
        """Return the causes as text, one sentence a line."""
        none = "no flipped sign, swapped joint, wrong clock, outlier or dead sensor explains the "
        return "\n".join(map(str, self.causes)) or none + "error"
