"""Rows of the contact problem with one force each: limits, friction loss and equalities."""
