"""Conversion of a compiled MuJoCo model to the parts of a `Model`."""
