"""From a compiled MuJoCo model to the parts of a `Model`."""
