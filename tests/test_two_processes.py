"""Two processes under `jax.distributed` on one machine find what one does."""

import socket

import jax
import numpy as np
import pytest

from tests.tolerances import F64_TRANSFORM, relative_error
from tests.two_processes import run


@pytest.mark.slow
def test_two_processes_find_what_one_does(tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    two, one = run(tmp_path, port)
    assert {*two} == {*one} == {"ends", "gradient", "scale", "mass"}
    for name in ("ends", "gradient", "mass"):
        assert relative_error(two[name], one[name]) <= F64_TRANSFORM, name
    np.testing.assert_allclose(two["scale"], 1.0, atol=1e-9)  # the masses that made the motions
    np.testing.assert_allclose(one["scale"], 1.0, atol=1e-9)
    np.testing.assert_allclose(two["mass"], 1.3, rtol=0.01)


def test_own_devices_are_asked_not_those_of_all(monkeypatch):
    """The first of `jax.devices()` may be of another process, which cannot be asked."""
    import rbjax as rb
    from rbjax.dynamics.tracing import devices

    monkeypatch.setattr(jax, "devices", None)
    assert devices.memory_share() > 0
    model = rb.load("pendulum")
    assert rb.rollout(model, model.default_state(), steps=2).q.shape == (3, 1)
