"""Ends of constraints and springs that are `rb.Frame`s: the same rows as from places."""

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc

POINT = (0.1, -0.2, 0.3)
TURN = (0.6, 0.0, 0.8, 0.0)
TEXT = """<mujoco><default><geom contype="0" conaffinity="0" size="0.1"/></default><worldbody>
  <body name="upper"><joint name="a" axis="0 1 0"/><geom mass="1"/>
    <site name="tip" pos="0.2 0.1 -0.4" euler="10 20 30"/>
    <body name="lower" pos="0 0 -0.5"><joint name="b" axis="1 0.5 0"/><geom mass="1"/></body>
  </body></worldbody></mujoco>"""
PLACE, FRAME = rb.forces.Place.on, rb.Frame


def rows(*ends):
    model = rb.load(TEXT).with_constraints(rc.Weld(*ends))
    q, v = np.array([0.4, -0.7]), np.array([0.3, 0.5])
    found = rc.residual(model, rb.State(q, v))
    return found.value, found.rate


@pytest.mark.parametrize(
    ("frame", "place"),
    [
        (FRAME("lower", POINT), PLACE(body="lower", point=POINT)),
        (FRAME(site="tip"), PLACE(site="tip")),
        (FRAME("world", POINT), PLACE(point=POINT)),
        (
            FRAME("lower", POINT, orientation=TURN),
            rb.forces.Place(np.array(POINT), np.array(TURN), "lower"),
        ),
    ],
)
def test_rows_of_frames(frame: rb.Frame, place: rb.forces.Place) -> None:
    other = FRAME("upper"), PLACE(body="upper")
    for got, want in zip(rows(frame, other[0]), rows(place, other[1]), strict=True):
        np.testing.assert_array_equal(got, want)


def test_between_frames_at_a_configuration() -> None:
    """The point of a joint is by default the origin of its first frame."""
    model, q = rb.load(TEXT), np.array([0.4, -0.7])
    _, tip = rb.frame_pose(model, q, FRAME(site="tip"))
    got = rc.Revolute.between(model, FRAME(site="tip"), FRAME("lower"), axis=[0, 1, 1], q=q)
    want = rc.Revolute.between(model, "upper", "lower", point=tip, axis=[0, 1, 1], q=q)
    for one, two in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-15)
    rod = rc.Distance.between(model, FRAME(site="tip"), FRAME("lower", POINT), q=q)
    _, end = rb.frame_pose(model, q, FRAME("lower", POINT))
    np.testing.assert_allclose(rod.length, np.linalg.norm(end - tip), rtol=1e-14)
    np.testing.assert_allclose(rod.b.position, POINT, atol=1e-15)


def test_a_spring_between_frames() -> None:
    model = rb.load(TEXT)
    ends = FRAME(site="tip"), FRAME("world", POINT)
    spring = rb.forces.PointSpring.of(*ends, stiffness=3.0)
    other = rb.forces.PointSpring.of(PLACE(site="tip"), PLACE(point=POINT), stiffness=3.0)
    assert jax.tree.structure(spring) == jax.tree.structure(other)
    state = model.default_state()
    got, want = (rb.applied_forces(model.with_forces(x), state) for x in (spring, other))
    np.testing.assert_array_equal(got, want)
