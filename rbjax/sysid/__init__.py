"""System identification: parameters of a model from measured motion."""

from rbjax.sysid.findings import Finding, findings
from rbjax.sysid.fit import Fit, Unknown, fit
from rbjax.sysid.readers import Column, read_csv, read_npz
from rbjax.sysid.recording import Channel, Recording, Split, split
from rbjax.sysid.units import in_si

__all__ = [
    "Fit",
    "Unknown",
    "fit",
    # recordings
    "Channel",
    "Recording",
    "Split",
    "split",
    "Column",
    "read_csv",
    "read_npz",
    "Finding",
    "findings",
    "in_si",
]
