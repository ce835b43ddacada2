"""What a name or a file has to show, and the errors of names that have nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.viewer import motion_of, view


def test_a_scene_is_a_posture(tmp_path: Path) -> None:
    found = motion_of("double_pendulum")
    assert found.trajectory is None and found.source == "double_pendulum"
    page = found.animate(tmp_path / "a.html")
    assert "double_pendulum" in page.read_text()


def test_a_saved_trajectory_is_a_motion(tmp_path: Path) -> None:
    model = rb.load("double_pendulum")
    q = jnp.linspace(0, 1, 5)[:, None] * jnp.ones(2)
    run = rb.Trajectory(jnp.linspace(0, 1, 5), q, jnp.ones((5, 2)), jnp.array(True))
    file = rb.loading.save_trajectory(tmp_path / "swing.npz", model, run, source="double_pendulum")
    found = motion_of(file)
    assert found.title == "swing" and found.source == "double_pendulum"
    assert found.trajectory is not None and len(found.trajectory) == 5
    assert found.animate(tmp_path / "b.html").exists()


def test_a_name_that_nothing_has() -> None:
    with pytest.raises(rb.UnknownName, match="cart_pole_balance"):
        motion_of("cart_pole_balanse")
    with pytest.raises(rb.ModelError, match="no such file"):
        motion_of("nowhere.xml")


def test_without_viser_the_command_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(rb.InputError, match=r"pip install 'rbjax\[viewer\]'.*--out page.html"):
        view(rb.load("pendulum"))


def test_a_task_moves_with_random_actions() -> None:
    found = motion_of("cart_pole_balance", samples=3, seconds=0.1)
    assert found.trajectory is not None and found.trajectory.q.shape == (3, 11, 2)
    assert found.title == "cart pole balance"
