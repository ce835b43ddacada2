"""Our robot files against the accelerations of the files that their numbers are from.

`tests/oracles/robots_of_tasks.json` has states and accelerations of MuJoCo 4.0.0 (tolerance 0) with
cartpole.xml, hopper.xml and walker.xml of MuJoCo Playground 0.2.0, and with Menagerie's
mjx_panda.xml without its meshes and Playground's mjx_single_cube.xml. Limits and contacts act in
most of the states.
"""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite.mujoco_states import ROBOTS

ORACLE = json.loads((Path(__file__).parents[2] / "oracles" / "robots_of_tasks.json").read_text())[
    "robots"
]


@pytest.mark.parametrize("name", ORACLE)
def test_accelerations_of_the_source(name):
    model, due = rb.load(str(ROBOTS / f"{name}.xml")), ORACLE[name]
    moving = due["mass"][: model.nb]  # without the target, which Playground has as a body
    np.testing.assert_allclose(model.bodies.mass, moving, rtol=1e-14)
    assert float(model.timestep) == due["timestep"]
    q, v, ctrl, a = (np.array([x[key] for x in due["states"]]) for key in ("q", "v", "ctrl", "a"))
    found = jax.vmap(lambda q, v, u: rb.acceleration(model, rb.State(q, v), u))(q, v, ctrl)
    # relative to the largest acceleration: both solvers end at rounding of the contact forces
    scale = np.abs(a).max(1, keepdims=True)
    np.testing.assert_allclose(found / scale, a / scale, atol=1e-10)
    assert max(x["rows"] for x in due["states"]) > 0
