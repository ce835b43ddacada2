"""Contacts with a direct stiffness and damping that a step does not resolve, against MuJoCo C."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.model import State
from tests.tolerances import F64_PARITY, relative_error

H = 0.002
#: a light ball on a floor, and a heavy one on it
PILE = """<mujoco><option timestep=".002" tolerance="0" iterations="100" ls_tolerance="1e-12"/>
<default><geom solref="{solref}"/></default><worldbody>
<geom name="floor" type="plane" size="0 0 1"/>
<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom name="light" size=".1" mass="1"/></body>
<body pos="0 0 .3"><joint type="slide" axis="0 0 1"/><geom name="heavy" size=".1" mass="{mass}"/>
</body></worldbody></mujoco>"""


def test_a_throw_is_the_one_of_mujoco() -> None:
    """1,000 kg on 1 kg with 1e8 1/s^2 and 1e5 1/s: the light ball is thrown, step by step as in
    MuJoCo, and the file warns with parameters that are stable."""
    m = mujoco.MjModel.from_xml_string(PILE.format(solref="-1e8 -1e5", mass=1000))
    with pytest.warns(UserWarning, match=r"floor and light have solref .* is 8") as found:
        model = rb.load(m)
    (text,) = [str(x.message) for x in found if "gains energy" in str(x.message)]
    assert 'solref="-62500 -500"' in text and "Take a step below 2e-05 s" in text
    d, run = mujoco.MjData(m), jax.jit(lambda q, v: rb.step(model, State(q, v)))
    largest = 0.0
    for _ in range(6):
        after = run(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
        mujoco.mj_step(m, d)
        largest = max(largest, np.abs(d.qacc).max())
        assert relative_error(after.v, d.qvel, floor=1.0) < F64_PARITY
    assert largest > 1e6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stable = rb.load(PILE.format(solref="-62500 -500", mass=1000))
    path = rb.rollout(stable, stable.default_state(), None, steps=1000)
    assert path.unconverged == 0
    assert float(path.q.max()) <= 0.0 and float(path.q.min()) > -0.05


@pytest.mark.parametrize("solref", ["-1e5 -850", "-4e5 -500", "-1e4 -950"])
def test_the_bound_of_stability(solref: str) -> None:
    """A ball of 1 kg: h^2 stiffness + 2 h damping is just below 4, and, at a larger damping, just
    above it."""
    stiffness, damping = (-float(x) for x in solref.split())
    for factor, thrown in ((1.0, False), (1.3, True)):
        given = f"{-stiffness} {-damping * factor}"
        total = H * H * stiffness + 2 * H * damping * factor
        assert (total > 4) == thrown
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            model = rb.load(PILE.format(solref=given, mass=1))
        assert any("gains energy" in str(x.message) for x in found) == thrown
        path = rb.rollout(model, model.default_state(), None, steps=1500)
        assert (float(path.q[:, 0].max()) > 1e-2) == thrown


def test_integrators_that_are_stable_and_models_without_contacts() -> None:
    """The `discrete` integrator takes the end of a step, and a model that touches nothing is not
    checked."""
    xml = PILE.format(solref="-1e8 -1e5", mass=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rb.load(xml.replace("<option", '<option integrator="discrete"'))
        warnings.filterwarnings("ignore", ".*left out of the model")
        rb.load(xml, contacts=False)
