"""A file without joints: every algorithm works, with the model closed over or an argument."""

import jax
import numpy as np
import pytest

import rbjax as rb
from tests.test_registry import REGISTRY

TABLE = rb.load(
    """<mujoco><worldbody>
      <body name="hand" pos="1 2 3" quat="1 0 0 1">
        <inertial pos="0.1 0 0" mass="2" diaginertia="1 1 1"/><site name="tip" pos="0.5 0 0"/>
        <body name="cup" pos="0 0 1"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
      </body></worldbody></mujoco>"""
)
SHAPES = {"wrenches": (2, 6), "mass": (2,), "com": (2, 3), "point": (3,)}


@pytest.mark.parametrize(
    ("closed", "driver"), [(True, "auto"), (False, "rolled")], ids=["closed over", "argument"]
)
def test_every_algorithm(closed: bool, driver: str) -> None:
    table = TABLE.replace(driver=driver)

    def every(model):
        out = {}
        for name, entry in REGISTRY.items():
            if name != "inertial_parameters":
                arrays = (np.zeros(SHAPES.get(a, (0,))) for a in entry.arrays)
                out[name] = entry.function(model, *arrays, **entry.rest)
        return out

    out = jax.jit(lambda: every(table))() if closed else jax.jit(every)(table)
    poses = out["forward_kinematics"]
    np.testing.assert_allclose(poses.p, [[1, 2, 3], [1, 2, 4]], atol=1e-15)
    _, p = rb.frame_pose(TABLE, np.zeros(0), site="tip")
    np.testing.assert_allclose(p, [1, 2.5, 3], atol=1e-15)
    np.testing.assert_allclose(out["center_of_mass"], [1, 2 + 0.2 / 3, 10 / 3], atol=1e-15)
    np.testing.assert_allclose(out["potential_energy"], 3 * 9.81 * 10 / 3, rtol=1e-15)
    assert out["mass_matrix"].shape == (0, 0) and out["jacobian"].shape == (6, 0)
    assert out["inertial_regressor"].shape == (0, 20) and out["forward_dynamics"].shape == (0,)
    assert out["jacobian_rate"].shape == (6, 0)
    assert out["kinetic_energy"] == 0 and out["step"][0].shape == (0,)
    assert not np.any(out["frame_velocity"]) and not np.any(out["frame_bias_acceleration"])
    assert not np.any(out["body_velocities"]) and not np.any(out["centroidal_momentum"])
