"""Derivatives of a solution by the implicit function theorem."""
