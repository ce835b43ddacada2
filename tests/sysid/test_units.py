"""Units against their definitions."""

import numpy as np

from rbjax.sysid.data.units import UNITS, in_si

PREFIX = {"": 1.0, "m": 1e-3, "k": 1e3, "c": 1e-2, "u": 1e-6, "n": 1e-9}
DEFINED = {
    "": 1.0, "1": 1.0, "%": 1 / 100, "min": 60.0, "rev": np.deg2rad(360), "deg": np.deg2rad(1),
    "in": 25.4e-3, "deg/s": np.deg2rad(1), "rev/s": np.deg2rad(360), "rpm": np.deg2rad(360) / 60,
    "deg/s^2": np.deg2rad(1), "km/h": 1000 / 3600, "g0": 9.80665,
}  # fmt: skip


def test_every_unit_is_as_defined():
    """Those not defined above are an SI unit with a prefix."""
    si = {"s", "rad", "rad/s", "rad/s^2", "m", "m/s", "m/s^2", "N", "N m", "A", "V"}
    for unit in UNITS:
        if unit in si:
            due = 1.0
        elif unit in DEFINED:
            due = DEFINED[unit]
        else:
            assert unit[1:] in si
            due = PREFIX[unit[0]]
        np.testing.assert_allclose(in_si(unit), due, rtol=1e-15, err_msg=unit)
