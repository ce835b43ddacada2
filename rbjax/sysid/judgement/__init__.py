"""Validation of an identification: diagnosis of wrong data, repeated fits, reports."""
