"""Weights of sensors from their residuals, and readers of names."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Recording, read_recording
from rbjax.sysid.estimators.staged_fit import estimate_weights
from rbjax.sysid.parameters import nearest_pseudo_inertia
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.traces import Trace

T = 0.1 * np.arange(30)
RNG = np.random.default_rng(0)


def weighed(noise=None, missing=False):
    """The weights that residuals of 0.3 and 0.02 give, of two columns."""
    y = np.stack([np.sin(T), np.cos(T)], 1)
    off = RNG.normal(size=y.shape) * [0.3, 0.02]
    if missing:
        y[4, 0] = np.nan
    there = ~np.isnan(y)
    run = Recording("run", {"q": Channel(T, y, noise=noise, dropped="nan")})
    data = Run(None, None, {"q": T[None]}, {"q": np.nan_to_num(y)[None]}, {"q": there[None] * 1.0})
    seen = {"run": {"q": Trace(("a", "b"), T, y, y + off)}}
    due = there / np.sqrt(np.nanmean(np.where(there, off, np.nan) ** 2, 0))
    return estimate_weights(data, seen, [run], robust=False), due


@pytest.mark.parametrize("missing", [False, True])
def test_a_sensor_is_weighed_by_its_residuals(missing):
    found, due = weighed(missing=missing)
    np.testing.assert_allclose(found.weights["q"][0], due, rtol=1e-12)


def test_a_sensor_whose_noise_is_stated_keeps_its_weights():
    assert weighed(noise=0.1)[0] is None


def test_joints_named_by_an_array_of_a_file(tmp_path):
    np.savez(tmp_path / "run.npz", angle=np.ones((50, 2)), joints=["hip", "knee"])
    run = read_recording(tmp_path / "run.npz", {"angle": ("q", "joints", "deg")}, rate=100)
    assert run["q"].names == ("hip", "knee")
    np.testing.assert_allclose(run["q"].values, np.deg2rad(1.0), rtol=1e-15)


def test_the_nearest_pseudo_inertia_has_clipped_eigenvalues():
    P = np.diag([-0.1, 0.5, 0.5, 2.0])
    due = np.diag([0.002, 0.5, 0.5, 2.0])
    found = nearest_pseudo_inertia(jnp.asarray([P, np.eye(4)]), 1e-3)
    np.testing.assert_allclose(found, [due, np.eye(4)], rtol=0, atol=1e-15)
    with pytest.raises(rb.InputError, match="P has shape"):
        nearest_pseudo_inertia(np.ones((4, 3)))
