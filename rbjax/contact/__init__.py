"""Contacts of geoms: which pairs may touch, where, and how far they are apart."""

from rbjax.contact.detection import Contacts, detect, pairs

__all__ = ["Contacts", "detect", "pairs"]
