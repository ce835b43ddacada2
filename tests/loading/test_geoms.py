"""Geoms of a model: MuJoCo's numbers, shapes of a URDF, pictures of a model."""

import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.loading import compile_model
from rbjax.plotting import solids
from tests.loading.test_load import joint, link, load_quietly, urdf

SHAPES = (
    '<{0}><origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><geometry><box size="0.2 0.4 0.6"/></geometry>'
    '</{0}><{0}><geometry><cylinder radius="0.3" length="0.8"/></geometry></{0}>'
    '<{0}><geometry><sphere radius="0"/></geometry></{0}>'
    '<{0}><geometry><mesh filename="none.stl"/></geometry></{0}>'
)


@pytest.mark.parametrize("scene", rb.scenes())
def test_a_file_keeps_its_geoms(scene: str) -> None:
    model, m = load_quietly(scene), compile_model(scene)
    geoms = model.geoms
    assert len(geoms.names) == m.ngeom
    for name in ("size", "friction", "solref", "solimp", "margin", "gap"):
        np.testing.assert_allclose(getattr(geoms, name), getattr(m, f"geom_{name}"), rtol=1e-6)
    np.testing.assert_array_equal(geoms.contype, m.geom_contype)
    d = mujoco.MjData(m)
    d.qpos[:] = model.default_state().q
    mujoco.mj_kinematics(m, d)
    for i, body in enumerate(geoms.bodies):
        R, p = d.xmat[body + 1].reshape(3, 3), d.xpos[body + 1]
        np.testing.assert_allclose(p + R @ geoms.position[i], d.geom_xpos[i], atol=1e-5)


def test_a_urdf_keeps_its_shapes_but_meshes_and_points() -> None:
    text = urdf(link("base"), link("arm"), joint("turn", "base", "arm", "continuous"))
    at = text.index("</link>", text.index('"arm"'))
    text = text[:at] + SHAPES.format("collision") + SHAPES.format("visual") + text[at:]
    model = load_quietly(text, contacts=False)
    geoms = model.geoms
    assert geoms.types == ("box", "cylinder") * 2 and geoms.contype == (1, 1, 0, 0)
    np.testing.assert_allclose(geoms.size[:2], [[0.1, 0.2, 0.3], [0.3, 0.4, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(geoms.position[0], [1, 2, 3], rtol=1e-6)
    assert not any(x.startswith("contacts") for x in model.dropped)
    assert any(x.startswith("collision shapes") for x in model.dropped)


def test_a_model_is_drawn_as_its_file() -> None:
    model = load_quietly("arm7")
    for a, b in zip(solids(model), solids("arm7"), strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-6)
        assert (a.body, a.color, a.alpha) == (b.body, b.color, b.alpha)


def test_a_geom_is_known_by_name() -> None:
    model = load_quietly("pendulum")
    name = model.geoms.names[-1]
    assert model.geom(name) == len(model.geoms.names) - 1
    with pytest.raises(rb.UnknownName, match="geom"):
        model.geom("none")
