"""Arrows of contact forces in drawings and animations."""

from __future__ import annotations

import base64
import json
import re
import warnings
import zlib

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact import ContactForces
from rbjax.plotting.contact_arrows import strokes, with_arrows
from rbjax.plotting.film import Camera, film
from rbjax.plotting.stick_figure import skeleton

BALL = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
<body name="ball" pos="0 0 .1"><freejoint/><geom type="sphere" size=".1" mass="2"/></body>
</worldbody></mujoco>"""


def ball() -> rb.Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rb.load(BALL, contacts=True)


def forces(*normal: float, lead: tuple[int, ...] = ()) -> ContactForces:
    """Contacts at the origin with normal forces of the plane on the ball; zero: no contact."""
    n = len(normal)
    frame = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    force = np.zeros((n, 6))
    force[:, 0] = normal
    fields = (np.array(normal) > 0, np.zeros(n), np.zeros((n, 3)), np.tile(frame, (n, 1, 1)), force)
    return ContactForces(*(jnp.broadcast_to(x, (*lead, *x.shape)) for x in fields), ((0, 1),) * n)


def film_of(model: rb.Model):
    q = np.asarray(model.default_state().q)
    return film(model, np.zeros(1), q[None, None], skeleton(model))


def test_an_arrow_of_the_weight_has_a_third_of_the_height() -> None:
    model, shown = ball(), film_of(ball())
    weight = float(model.bodies.mass.sum() * 9.81)
    arrows = with_arrows("draw", shown, model, forces(weight, 0.0, 100 * weight)).arrows
    assert arrows.shape == (1, 3, 2, 3)
    height = shown.size.max()
    np.testing.assert_allclose(arrows[0, 0], [[0, 0, 0], [0, 0, height / 3]], atol=1e-6 * height)
    assert np.isnan(arrows[0, 1]).all()
    assert arrows[0, 2, 1, 2] == pytest.approx(2 / 3 * height)
    lines = strokes(arrows[0], Camera(-90, 0).axes[:2], 0.1)
    assert [len(x) for x in lines] == [2, 3, 2, 3]
    assert lines[0][1] == pytest.approx([0, height / 3], rel=1e-5)
    assert with_arrows("draw", shown, model, None) is shown


def test_the_arrow_is_on_the_body_that_moves() -> None:
    """The geoms in the other order: the force on the plane is turned around."""
    model = ball()
    turned = forces(10.0)
    turned = ContactForces(*(getattr(turned, k) for k in ("exists", "distance", "position")),
                           -turned.frame, turned.force, ((1, 0),))  # fmt: skip
    arrows = with_arrows("draw", film_of(model), model, turned).arrows
    assert arrows[0, 0, 1, 2] > 0


def test_drawn_with_arrows() -> None:
    model = ball()
    ax = matplotlib.figure.Figure(figsize=(4, 3)).add_subplot()
    rb.plotting.draw(model, model.default_state(), ax=ax, source=BALL, contacts=forces(19.62))
    ax.figure.canvas.draw()
    assert any(len(x.get_paths()) == 2 and x.get_zorder() == 4 for x in ax.collections)
    assert any(len(x.get_offsets()) == 1 and x.get_zorder() == 5 for x in ax.collections)


def test_a_page_has_the_arrows_of_each_frame(tmp_path) -> None:
    model = ball()
    start = model.default_state()
    still = jax.tree.map(lambda x: jnp.stack([x] * 3), start)
    path = rb.motion.trajectory.Trajectory(
        jnp.array([0.0, 0.1, 0.2]), still.q, still.v, jnp.array(True)
    )
    for contacts in (forces(5.0, 0.0, lead=(3,)), forces(5.0, 0.0, lead=(2, 3))):
        file = rb.plotting.animate(model, path, tmp_path / "ball.html", contacts=contacts, fps=20)
        text = file.read_text()
        data = json.loads(re.search(r'id="data"[^>]*>(.*?)</script>', text, re.S).group(1))
        arrows = np.frombuffer(zlib.decompress(base64.b64decode(data["arrows"])), "<f4")
        assert data["pushes"] == 2 and arrows.size == data["frames"] * 2 * 6
    rb.plotting.animate(model, path, tmp_path / "ball.html")
    rb.plotting.animate(model, path, tmp_path / "ball.gif", contacts=contacts, size=(160, 120))


def test_bad_contacts() -> None:
    model = ball()
    ax = matplotlib.figure.Figure().add_subplot()
    with pytest.raises(rb.InputError, match="draw: contacts is 3, expected ContactForces"):
        rb.plotting.draw(model, model.default_state(), ax=ax, contacts=3)
    with pytest.raises(rb.InputError, match=r"contacts.position has shape \(4, 1, 3\)"):
        rb.plotting.draw(model, model.default_state(), ax=ax, contacts=forces(1.0, lead=(4,)))
