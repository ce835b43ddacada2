"""Trajectories in files: what is written is read again, with the robot; errors in a sentence."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.loading import load_trajectory, save_trajectory

ARM = """<mujoco><option timestep="0.004"/><worldbody><body name="arm"><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/></body></worldbody></mujoco>"""


def still(model: rb.Model, *lead: int) -> rb.Trajectory:
    ts = jnp.linspace(0.0, 1.0, 5)
    q = jnp.broadcast_to(model.default_state().q, (*lead, 5, model.nq)) + ts[:, None]
    return rb.Trajectory(ts, q, jnp.ones((*lead, 5, model.nv)), jnp.ones(lead, bool))


@pytest.mark.parametrize("lead", [(), (3,)])
def test_written_and_read(lead: tuple[int, ...], tmp_path: Path) -> None:
    model = rb.load(ARM)
    run = still(model, *lead)
    found = load_trajectory(save_trajectory(tmp_path / "a.npz", model, run))
    for name in ("ts", "q", "v", "success"):
        np.testing.assert_array_equal(getattr(found.trajectory, name), getattr(run, name))
    assert found.model.timestep == 0.004 and found.model.body_names == ("arm",)
    np.testing.assert_allclose(found.model.bodies.mass, model.bodies.mass, rtol=1e-12)
    assert found.source.lstrip().startswith("<")


def test_the_file_of_the_robot_is_drawn_while_it_exists(tmp_path: Path) -> None:
    file = tmp_path / "arm.xml"
    file.write_text(ARM)
    model = rb.load(file)
    saved = save_trajectory(tmp_path / "a.npz", model, still(model), source=file)
    assert load_trajectory(saved).source == str(file)
    file.write_text("<mujoco/>")
    assert load_trajectory(saved).source.startswith("<")
    file.unlink()
    assert load_trajectory(saved).model.nq == 1


def test_a_beam_cannot_be_written(tmp_path: Path) -> None:
    model = rb.load(ARM).with_beam(
        "rod", rb.flexible.beam(1.0, [1, 1, 1, 0, 0, 0], mass=1.0), "arm"
    )
    with pytest.raises(rb.InputError, match="MJCF cannot express this model"):
        save_trajectory(tmp_path / "a.npz", model, still(model))


def test_errors(tmp_path: Path) -> None:
    model = rb.load(ARM)
    with pytest.raises(rb.InputError, match=r"ends in \.npz"):
        save_trajectory(tmp_path / "a.txt", model, still(model))
    with pytest.raises(rb.InputError, match="give the model that made the trajectory"):
        save_trajectory(tmp_path / "a.npz", model, still(rb.load("double_pendulum")))
    with pytest.raises(rb.InputError, match="no file"):
        load_trajectory(tmp_path / "b.npz")
    (tmp_path / "c.npz").write_text("no arrays")
    with pytest.raises(rb.InputError, match=r"is not an \.npz file"):
        load_trajectory(tmp_path / "c.npz")
    np.savez(tmp_path / "d.npz", ts=np.zeros(2), q=np.zeros((2, 1)))
    with pytest.raises(rb.InputError, match="has no mjcf, source, v"):
        load_trajectory(tmp_path / "d.npz")
