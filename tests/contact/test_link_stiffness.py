"""Sums of contact stiffness by link, and robots of which only some equal limbs can touch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.contact_axes import ContactAxes
from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.lanes import Vec3
from rbjax.spatial import Motion

#: four equal legs; `{touches}` are the feet with a contact
LEGS = """
<mujoco><option timestep="0.002"><flag eulerdamp="disable"/></option>
<worldbody><geom type="plane" size="2 2 1" name="floor"/>
<body pos="0 0 0.28"><freejoint/><geom type="box" size="0.2 0.1 0.03" mass="3" contype="0"
  conaffinity="0"/>{legs}</body></worldbody></mujoco>
"""
LEG = """
<body pos="{x} {y} 0"><joint axis="0 1 0" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0.05 0 -0.13" size="0.02" mass="0.4" contype="0"
    conaffinity="0"/>
  <body pos="0.05 0 -0.13"><joint axis="0 1 0" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 -0.05 0 -0.13" size="0.02" mass="0.2" contype="{touch}"
      conaffinity="{touch}"/></body></body>
"""


def robot(touches: tuple[int, ...]) -> mujoco.MjModel:
    """Return four legs, of which some touch the floor."""
    places = [(x, y) for x in (0.18, -0.18) for y in (0.1, -0.1)]
    legs = "".join(LEG.format(x=x, y=y, touch=int(k in touches)) for k, (x, y) in enumerate(places))
    compiled = mujoco.MjModel.from_xml_string(LEGS.format(legs=legs))
    compiled.opt.tolerance, compiled.opt.iterations = 0.0, 100
    return compiled


@pytest.mark.parametrize("driver", ["limbs", "unrolled"])
@pytest.mark.parametrize("touches", [(0,), (1, 2), (3,), (0, 1, 2, 3)])
def test_some_limbs_touch(driver: str, touches: tuple[int, ...]) -> None:
    """Limbs that cannot touch get no stiffness, though equal limbs have some."""
    compiled = robot(touches)
    model, data = rb.load(compiled).replace(driver=driver), mujoco.MjData(compiled)
    data.qpos[2] = 0.275
    data.qvel[:] = np.random.default_rng(0).normal(size=compiled.nv) / 3
    mujoco.mj_forward(compiled, data)
    assert data.ncon == len(touches)
    run = jax.jit(rb.threads(lambda q, v: rb.acceleration(model, rb.State(q, v))))
    found = run(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    np.testing.assert_allclose(found, data.qacc, atol=1e-10 * np.abs(data.qacc).max())


def test_sums() -> None:
    """Terms add up by pair; pairs without a term, and negative indices, are zero."""
    rng = np.random.default_rng(1)
    axes = ContactAxes(Vec3(0.1, -0.2, 0.3), [Vec3(*x) for x in np.eye(3)], 3)

    def sums(H: jax.Array) -> jax.Array:
        K = axes.stiffness([[H[i, j] for j in range(i + 1)] for i in range(3)])
        out = LinkStiffness.zero(3, H.dtype).add(jnp.int32(1), K).add(jnp.int32(1), K)
        found = [out.at(k) for k in (0, 1, jnp.int32(1), jnp.int32(-1))]
        return jnp.stack([jnp.stack([*x.J, *x.H, *x.M]) for x in found])

    H = rng.normal(size=(3, 3))
    none, two, again, outside = np.asarray(jax.jit(sums)(jnp.asarray(H + H.T)))
    assert not none.any() and not outside.any()
    np.testing.assert_array_equal(two, again)
    np.testing.assert_allclose(
        two[-6:], 2 * np.array((H + H.T)[np.tril_indices(3)])[[0, 2, 5, 1, 3, 4]]
    )


@pytest.mark.parametrize("dim", [1, 3, 4, 6])
def test_axes_of_a_contact(dim: int) -> None:
    """Rates, wrenches and the stiffness equal products with the unit motions b_k."""
    rng = np.random.default_rng(dim)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes = ContactAxes(Vec3(*rng.normal(size=3)), [Vec3(*x) for x in frame][:dim], dim)
    assert axes.lanes == ContactAxes.from_lanes(axes.lanes, dim).lanes
    assert len(axes.lanes) == ContactAxes.size(dim)
    B = np.array([list(axes.row(k)) for k in range(dim)], float)
    y, f, H = rng.normal(size=6), rng.normal(size=dim), rng.normal(size=(dim, dim))
    H = H + H.T
    np.testing.assert_allclose(axes.rates(Motion.from_lanes(y)), B @ y, atol=1e-14)
    np.testing.assert_allclose(list(axes.wrench(list(f))), B.T @ f, atol=1e-14)
    K = axes.stiffness([list(row[: i + 1]) for i, row in enumerate(H)])
    columns = [list(K(Motion.from_lanes(x))) for x in np.eye(6)]
    np.testing.assert_allclose(np.array(columns, float), B.T @ H @ B, atol=1e-13)
