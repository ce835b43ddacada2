"""Models in pickles: another process has the same motion, and this one the same program."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.flexible.modal import add_modal_body, from_points
from rbjax.lanes import Mat3, Vec3
from rbjax.spatial import Transform
from tests.flexible.beams import round_beam
from tests.flexible.modal.points import random_points
from tests.tolerances import F64_TRANSFORM, relative_error

CHILD = """
import pickle, sys
import jax, numpy as np, rbjax as rb
models = pickle.load(open(sys.argv[1], "rb"))
from tests.model.test_pickling import accelerations
np.savez(sys.argv[2], **accelerations(models))
"""


class Cubic(rb.joints.Node):
    """A bead on a cubic. It is registered where the models are made, not on import."""

    name, coordinates = "cubic", 1
    params = {"slope": 1.0}  # noqa: RUF012

    def pose(self, q, params):
        return Transform(Mat3.identity(), Vec3(q[0], 0.0, params[0] * q[0] ** 3))


def models() -> dict[str, rb.Model]:
    """A model for each source of joint kinds: built in, beams, a modal body, a user."""
    rb.joints.register(Cubic())
    world, rod = rb.load("<mujoco/>"), round_beam({"k_y": 3})
    points = random_points(np.random.default_rng(0), n=4, m=2)
    blobs = [from_points(**points, stiffness=np.eye(2), frames=range(k)) for k in (1, 2)]
    return {
        "rigid": rb.load("cart_pole"),
        "beam": world.with_beam("rod", rod, frames={"middle": 0.5}),
        "reduced": world.with_beam("rod", rod.reduced(rod.vibration_modes(2))),
        "modal": add_modal_body(add_modal_body(world, "one", blobs[0]), "two", blobs[1]),
        "user": rb.load("cart_pole").with_joint("slider", "cubic", slope=0.5),
    }


def accelerations(models: dict[str, rb.Model]) -> dict[str, jax.Array]:
    """Accelerations by forward dynamics, at q = 0.1."""
    return {
        name: rb.forward_dynamics(m, jnp.full(m.nq, 0.1), jnp.full(m.nv, 0.2), jnp.zeros(m.nv))
        for name, m in models.items()
    }


def test_another_process_loads_every_kind_of_joint(tmp_path: Path) -> None:
    here = models()
    given, found = tmp_path / "models.pickle", tmp_path / "found.npz"
    given.write_bytes(pickle.dumps(here))
    child = subprocess.run(
        [sys.executable, "-c", CHILD, str(given), str(found)],
        capture_output=True, text=True, cwd=Path(__file__).parents[2],
        env={**os.environ, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    assert child.returncode == 0, child.stderr
    there = np.load(found)
    for name, want in accelerations(here).items():
        assert relative_error(there[name], want) < F64_TRANSFORM, name


def test_a_copy_has_the_same_program() -> None:
    """Kinds of joints that are registered are not created again."""
    for name, model in models().items():
        again = pickle.loads(pickle.dumps(model)).topology
        assert again == model.topology and hash(again) == hash(model.topology), name
