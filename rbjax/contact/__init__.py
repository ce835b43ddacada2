"""Contacts of geoms: which pairs may touch, where, how far they are apart, and their forces."""

from rbjax.contact.detection import Contacts, detect, pairs
from rbjax.contact.registry import laws
from rbjax.contact.soft import SoftContact

__all__ = ["Contacts", "SoftContact", "detect", "laws", "pairs"]
