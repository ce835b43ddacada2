"""Stiffness, damping and mass of beams from torques (`rb.sysid.torque`)."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import ModelError
from rbjax.sysid import Channel, Recording
from rbjax.sysid.torque import (
    base_parameters,
    consistent,
    parameter_names,
    parameter_values,
    regress,
    regressor,
    torque_rows,
)
from tests.dynamics.test_modal_link import moving as with_modal_link
from tests.flexible.beams import ARM, on_a_hinge, round_beam
from tests.flexible.test_regressor import tree
from tests.tolerances import F64_IDENTITY


def coupled() -> rb.Model:
    """A beam whose bending is coupled with its extension and torsion, on an arm."""
    C = np.diag([3.0, 2.0, 1.0, 40.0, 0.0, 0.0])
    C[0, 1] = C[1, 0] = 0.4
    C[1, 3] = C[3, 1] = 1.5
    rod = rb.flexible.beam(
        0.6, C, {"k_x": 0, "k_y": 1, "e_x": 1}, mass=0.4, inertia=(4e-3, 2e-3, 2e-3), damping=0.05
    )
    return rb.load(ARM).with_beam("rod", rod, "upper", position=(0, 0, -0.4))


def torques(model: rb.Model, q, v, a):
    """Torques of motors: inverse dynamics without the elastic and viscous forces of the beams."""
    bare = model.replace(joints=model.joints.replace(damping=0 * model.joints.damping))
    passive = rb.applied_forces(bare, rb.State(q, v))
    return rb.inverse_dynamics(model, q, v, a) - passive


@pytest.mark.parametrize("make", [on_a_hinge, tree, coupled])
def test_torques_are_linear_in_the_sections(make) -> None:
    """Y pi at the numbers of the model, and after finite changes of stiffness and viscosity.

    `tree` has a tapered beam of four Gauss points, and `coupled` a full matrix.
    """
    model = make()
    keys = jax.random.split(jax.random.key(1), 3)
    q, v, a = (0.5 * jax.random.normal(k, (model.nv,)) for k in keys)
    terms = ["armature"]
    Y = regressor(model, q, v, a, joint_terms=terms)
    names = parameter_names(model, terms)
    assert Y.shape == (model.nv, len(names)) and len(set(names)) == len(names)

    def differs(one: rb.Model) -> np.ndarray:
        return np.asarray(Y @ parameter_values(one, terms) - torques(one, q, v, a))

    scale = np.abs(torques(model, q, v, a)).max()
    assert np.abs(differs(model)).max() < F64_IDENTITY * scale
    elements = [x for x in model.forces if isinstance(x, rb.flexible.BeamElasticity)]
    changed = [
        x.replace(stiffness=1.7 * x.stiffness, viscosity=0.3 * x.viscosity + 0.01 * x.stiffness)
        for x in elements
    ]
    other = model.replace(forces=tuple(changed))
    assert np.abs(torques(other, q, v, a) - torques(model, q, v, a)).max() > 1e-3 * scale
    assert np.abs(differs(other)).max() < F64_IDENTITY * scale


def test_names_and_values() -> None:
    names = rb.flexible.elastic_names(coupled())
    assert names[:3] == ("rod.stiffness[k_x]", "rod.stiffness[k_x, k_y]", "rod.stiffness[k_x, e_x]")
    values = dict(zip(names, rb.flexible.elastic_parameters(coupled()).tolist(), strict=True))
    assert values["rod.stiffness[k_y, e_x]"] == 1.5 and values["rod.stiffness[e_x]"] == 40.0
    assert values["rod.viscosity[k_y]"] == pytest.approx(0.1)
    assert rb.flexible.elastic_names(tree())[1] == "one.stiffness[0, k_y]"
    model = on_a_hinge()
    assert parameter_names(model, ["viscous"])[-5:] == (
        "rod.stiffness[k_y]", "rod.stiffness[k_z]", "rod.viscosity[k_y]", "rod.viscosity[k_z]",
        "hip.viscous",
    )  # fmt: skip
    pendulum = rb.load("pendulum")
    assert rb.flexible.elastic_names(pendulum) == ()
    assert rb.flexible.elastic_regressor(pendulum, jnp.ones(1), jnp.ones(1)).shape == (1, 0)


def test_bending_stiffness_damping_and_mass_from_noisy_torques() -> None:
    """EI, its viscosity and the mass per length of a beam on a motor, within their intervals.

    Torques have noise of 1e-3 N m. The torque on the coordinates of the beam is zero, with the same
    noise, as of strains that are measured.
    """
    arm = rb.load(ARM.replace('damping="0.1"', ""))
    rod = round_beam({"k_y": 1}, damping=0.02)
    model = arm.with_beam("rod", rod, "upper", position=(0, 0, -0.4))
    rng = np.random.default_rng(3)
    q, v, a = (jnp.asarray(rng.normal(size=(300, model.nv))) for _ in range(3))
    W = np.asarray(regressor(model, q, v, a))
    exact = np.asarray(jax.vmap(lambda *x: torques(model, *x))(q, v, a))
    names = parameter_names(model)
    first = ["rod.mass_per_length[0]", "rod.stiffness[k_y]", "rod.viscosity[k_y]"]
    base = base_parameters(model, q, v, a, first=first)
    found = regress(W, exact + 1e-3 * rng.normal(size=exact.shape), names, noise=1e-3, base=base)
    assert found.success
    EI = 1e8 * np.pi * 0.01**4 / 4
    values = dict(zip(names, np.asarray(parameter_values(model)), strict=True))
    assert values["rod.stiffness[k_y]"] == pytest.approx(EI)
    assert values["rod.viscosity[k_y]"] == pytest.approx(0.02 * EI)
    want = base.combine(np.asarray(parameter_values(model)))
    terms = base.terms()
    for name, close in (("rod.stiffness[k_y]", 1e-3), ("rod.viscosity[k_y]", 1e-2)):
        k = terms.index(name)  # identified by itself
        assert found.beta[k] == pytest.approx(values[name], rel=close)
    low, high = found.intervals(0.999).T
    assert ((low < want) & (want < high)).all()
    assert any(term.startswith("rod.mass_per_length") for term in terms)


def test_rows_of_a_recording() -> None:
    """Filtered equations of a motion of sines, with their exact torques."""
    arm = rb.load(ARM.replace('damping="0.1"', ""))
    model = arm.with_beam(
        "rod", round_beam({"k_y": 1}, damping=0.02), "upper", position=(0, 0, -0.4)
    )
    t = np.arange(0.0, 8.0, 0.002)
    waves = np.random.default_rng(7).uniform(2.0, 9.0, (3, 1, model.nv))
    s, c = np.sin(waves * t[:, None]), np.cos(waves * t[:, None])
    q, v, a = 0.3 * s.sum(0), 0.3 * (waves * c).sum(0), -0.3 * (waves**2 * s).sum(0)
    tau = jax.vmap(lambda *x: torques(model, *x))(*map(jnp.asarray, (q, v, a)))
    run = Recording("run", {"q": Channel(t, q), "tau": Channel(t, np.asarray(tau))})
    rows = torque_rows(model, run, 5.0)
    found = regress(rows.W, rows.tau, rows.names)
    values = dict(zip(rows.names, np.asarray(parameter_values(model)), strict=True))
    fitted = dict(zip(found.combinations.terms(), found.beta, strict=True))
    for name in ("rod.stiffness[k_y]", "rod.viscosity[k_y]"):
        assert fitted[name] == pytest.approx(values[name], rel=1e-4)


def test_what_cannot_be_fitted_is_said() -> None:
    model, q, v, a = with_modal_link()
    with pytest.raises(ModelError, match="flexible and not a beam"):
        regressor(model, q, v, a)
    beam = on_a_hinge()
    p = len(parameter_names(beam))
    with pytest.raises(rb.InputError, match=re.escape("the model has beams, whose sections")):
        consistent(beam, np.zeros((50, beam.nv, p)), np.zeros((50, beam.nv)))
