"""System identification: parameters of a model from measured motion."""

from rbjax.sysid.channel_noise import ChannelNoise, noise_by_channel
from rbjax.sysid.comparison import Comparison, HeldOut, Scored, compare, held_out
from rbjax.sysid.excitation import Fourier, Motion, Spline
from rbjax.sysid.experiments import Experiment, MotionLimits, design
from rbjax.sysid.filtering import Filtered, differentiate, low_pass
from rbjax.sysid.findings import Finding, findings
from rbjax.sysid.fit import Fit, Unknown, fit
from rbjax.sysid.readers import Column, read_csv, read_npz
from rbjax.sysid.recording import Channel, Recording
from rbjax.sysid.splits import Split, split
from rbjax.sysid.statistics import Estimates, Interval, crlb, estimates, information
from rbjax.sysid.units import in_si
from rbjax.sysid.whiteness import Whiteness, sandwich, whiteness

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
    # signals
    "Filtered",
    "differentiate",
    "low_pass",
    # statistics
    "ChannelNoise",
    "Estimates",
    "Interval",
    "crlb",
    "estimates",
    "information",
    "noise_by_channel",
    "Whiteness",
    "sandwich",
    "whiteness",
    "Comparison",
    "HeldOut",
    "Scored",
    "compare",
    "held_out",
    # experiments
    "Fourier",
    "Motion",
    "Spline",
    "Experiment",
    "MotionLimits",
    "design",
]
