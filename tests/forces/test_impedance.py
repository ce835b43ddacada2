"""Impedance, reference and regularisation of soft rows: MuJoCo's rows, derivatives, precision."""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax.forces.impedance import impedance, reference, regularisation
from rbjax.model.solver_parameters import SOLREF

#: standard, direct, without damping, mixed signs in both orders, and faster than two time steps
REFERENCES = ["0.02 1", "-300 -20", "-300 0", "0.05 -3", "-5 0.3", "0.05 0", "0.001 0.5"]
#: the default, out of bounds, without a width, a constant, falling, and the powers 1 and 3.5
IMPEDANCES = [
    "0.9 0.95 0.001 0.5 2", "-0.1 1.2 0.02 1.3 0.4", "0.3 0.8 0 0.5 2", "0.7 0.7 0.1 0.5 2",
    "0.95 0.2 0.05 0.2 3.5", "0 0.9999 0.3 0.9 6", "0.1 0.9 0.2 0.5 1",
]  # fmt: skip
TYPES = mujoco.mjtConstraint
SCENE = """<mujoco><option timestep="0.003" cone="{cone}" impratio="{ratio}">
  <flag refsafe="{safe}" eulerdamp="disable"/></option>
<default><geom condim="{dim}" solref="{ref}" solimp="{imp}" friction="0.7 0.02 0.01"/>
  <joint solreflimit="{ref}" solimplimit="{imp}" solreffriction="{ref}" solimpfriction="{imp}"/>
</default>
<worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 0.35"><joint type="slide" axis="0 0 1" margin="0.02" range="-0.05 0.04"
      limited="true" frictionloss="0.3"/>
    <joint axis="0 1 0.2" range="-20 25" limited="true" margin="0.05" frictionloss="0.2"/>
    <joint type="slide" axis="1 0 0"/>
    <geom type="capsule" fromto="-0.3 0 0 0.3 0 0" size="0.1" margin="0.05"/>
    <body pos="0.4 0 0"><joint type="ball" range="0 15" limited="true" frictionloss="0.01"/>
      <geom type="box" size="0.1 0.15 0.2"/></body></body>
</worldbody></mujoco>"""


def inverse_inertia(m: mujoco.MjModel, d: mujoco.MjData, row: int) -> float:
    """MuJoCo's approximate diagonal of J M^-1 J^T."""
    kind, i = d.efc_type[row], d.efc_id[row]
    if kind == TYPES.mjCNSTR_FRICTION_DOF:
        return m.dof_invweight0[i]
    if kind == TYPES.mjCNSTR_LIMIT_JOINT:
        return m.dof_invweight0[m.jnt_dofadr[i]]
    weight = m.body_invweight0[m.geom_bodyid[d.contact.geom[i]], 0].sum()
    pyramidal = kind == TYPES.mjCNSTR_CONTACT_PYRAMIDAL
    return weight * (1 + d.contact.friction[i, 0] ** 2) if pyramidal else weight


@functools.cache
def rows(cone: str, ratio: float, dim: int, safe: str, choice: int) -> dict[str, np.ndarray]:
    """MuJoCo's rows in random states."""
    ref, imp = REFERENCES[choice % 7], IMPEDANCES[(3 * choice + dim) % 7]
    text = SCENE.format(cone=cone, ratio=ratio, dim=dim, safe=safe, ref=ref, imp=imp)
    m = mujoco.MjModel.from_xml_string(text)
    d, rng, out = mujoco.MjData(m), np.random.default_rng(choice), []
    for _ in range(6):
        d.qpos[:] = m.qpos0 + 0.3 * rng.normal(size=m.nq) * rng.random()
        d.qvel[:] = rng.normal(size=m.nv)
        mujoco.mj_normalizeQuat(m, d.qpos)
        mujoco.mj_forward(m, d)
        names = ("type", "pos", "margin", "vel", "aref", "R")
        own = {name: getattr(d, f"efc_{name}").copy() for name in names}
        own["weight"] = np.array([inverse_inertia(m, d, i) for i in range(d.nefc)])
        first = np.array([c.efc_address for c in d.contact[: d.ncon]], int)
        own["first"] = np.isin(np.arange(d.nefc), first)
        out.append(own)
    found = {k: np.concatenate([x[k] for x in out]) for k in out[0]}
    return found | {"solref": np.array(ref.split(), float), "solimp": np.array(imp.split(), float)}


CASES = list(itertools.product(("pyramidal", "elliptic"), (1, 3, 4, 6), ("enable", "disable")))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("cone", "dim", "safe"), CASES)
def test_rows_of_mujoco(cone: str, dim: int, safe: str) -> None:
    seen: set[int] = set()
    for choice, ratio in itertools.product(range(7), (1.0, 7.5)):
        x = rows(cone, ratio, dim, safe, choice)
        friction = np.isin(x["type"], [TYPES.mjCNSTR_FRICTION_DOF])
        elliptic = x["type"] == TYPES.mjCNSTR_CONTACT_ELLIPTIC
        tangent = elliptic & ~x["first"]
        r = np.where(friction | tangent, 0.0, x["pos"] - x["margin"])
        d = impedance(r, x["solimp"])
        own = ~tangent  # the impedance of a tangent is the one of its normal
        solref, solimp = x["solref"], x["solimp"]
        found = reference(r, x["vel"], d, solref, solimp, 0.003, refsafe=safe == "enable")
        scale = np.abs(x["aref"]).max(initial=1.0)
        np.testing.assert_allclose(found, x["aref"], rtol=0, atol=1e-14 * scale)
        plain = own & (x["type"] != TYPES.mjCNSTR_CONTACT_PYRAMIDAL)
        R = regularisation(d, x["weight"])
        np.testing.assert_allclose(R[plain], x["R"][plain], rtol=1e-13)
        for i in np.flatnonzero(tangent & np.roll(x["first"], 1)):
            np.testing.assert_allclose(x["R"][i], R[i - 1] / ratio, rtol=1e-13)
        edges = x["type"] == TYPES.mjCNSTR_CONTACT_PYRAMIDAL
        expected = R * 2 * 0.7**2 / ratio
        np.testing.assert_allclose(x["R"][edges], expected[edges], rtol=1e-13)
        seen |= {int(t) for t in x["type"]}
    assert len(seen) == 3  # friction loss, limits, and one type of contacts


def outputs(x: jax.Array) -> jax.Array:
    """Impedance, reference and regularisation of (r, solimp, solref, velocity)."""
    r, solimp, solref, velocity = x[0], x[1:6], x[6:8], x[8]
    d = impedance(r, solimp)
    aref = reference(r, velocity, d, solref, solimp, 0.01, refsafe=True)
    return jnp.stack([d, aref, regularisation(d, 2.0)])


forward, reverse = (jax.jit(jax.vmap(jac(outputs))) for jac in (jax.jacfwd, jax.jacrev))


def test_derivatives_are_finite_everywhere() -> None:
    cases = itertools.product(
        [0.0, -1e-30, 0.05, -0.05, 0.1, -0.1, 3.0, -0.02],
        [(0.2, 0.9), (0.5, 0.5), (-1.0, 2.0), (1e-4, 0.9999)],
        [0.0, -1.0, 0.1],
        [0.5, 0.0],
        [0.5, 1.0, 1.5, 2.0, 300.0],
        [(0.0, 0.0), (0.02, 0.0), (0.0, 1.0), (0.01, 1.0), (-1.0, 0.0)],
    )
    x = jnp.array([(r, *imp, w, m, p, *ref, 0.3) for r, imp, w, m, p, ref in cases])
    for jacobian in (forward(x), reverse(x)):
        wrong = ~jnp.isfinite(jacobian).all((1, 2))
        assert not wrong.any(), x[wrong][0]


def test_derivatives_are_those_of_differences() -> None:
    powers, residuals = [1.0, 1.7, 2.0, 4.0], [-0.01, 0.03, -0.07, -0.2]
    cases = itertools.product(residuals, powers, [(0.05, 0.8), (-30.0, -2.0)])
    x = jnp.array([(r, 0.2, 0.9, 0.1, 0.4, p, *ref, 0.3) for r, p, ref in cases])
    h = 1e-6 * jnp.eye(9)
    values = jax.jit(jax.vmap(jax.vmap(outputs)))
    differences = (values(x[:, None] + h) - values(x[:, None] - h)).swapaxes(1, 2) / 2e-6
    exact = forward(x)
    scale = jnp.abs(exact).max(-1, keepdims=True)
    edge = (x[:, 5] == 1.0)[:, None, None] & (jnp.arange(9) == 5)  # the power is 1 or more
    np.testing.assert_allclose(
        jnp.where(edge, 0.0, (exact - differences) / scale), 0.0, rtol=0, atol=1e-8
    )


def test_constants_vanish_and_the_dtype_is_that_of_the_residual() -> None:
    solimp = np.array([0.9, 0.95, 0.001, 0.5, 2.0])

    def constants(v):
        assert isinstance(impedance(0.0, solimp), float)
        return reference(0.0, v, 0.0, SOLREF, solimp, 0.002, refsafe=True)

    program = jax.make_jaxpr(constants)(jnp.float32(1.0))
    assert [str(e.primitive) for e in program.eqns] == ["mul"]
    for r in (jnp.float32(-0.0004), -0.0004 * jnp.ones((3,), jnp.float32)):
        for given in (solimp, jnp.asarray(solimp), jnp.asarray(solimp)[:, None] * jnp.ones(3)):
            if r.ndim == 0 and given.ndim == 2:
                continue
            d = jax.jit(lambda r, given=given: impedance(r, given))(r)
            assert (d.dtype, d.shape) == (jnp.float32, r.shape)
            np.testing.assert_allclose(d, impedance(np.float64(-0.0004), solimp), rtol=1e-6)
