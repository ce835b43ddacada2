"""Rough ground: its heights, and what cannot be made."""

import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import walking

XML = '<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/></worldbody></mujoco>'


def test_heights_are_those_that_mujoco_reads():
    xml = rb.envs.rough_ground(walking.path("go1").read_text(), points=32, height=0.07, seed=3)
    theirs, ours = mujoco.MjModel.from_xml_string(xml), rb.load(xml)
    heights = theirs.hfield_data.reshape(32, 32) * 0.07
    np.testing.assert_allclose(ours.geoms.heights[0], heights, atol=1e-7)  # MuJoCo has f32
    assert heights.min() == 0 and np.isclose(heights.max(), 0.07)
    # uniform and independent: the standard deviation of 1,024 within 5 %
    assert abs(heights.std() / (0.07 / np.sqrt(12)) - 1) < 0.05
    assert abs(np.corrcoef(heights[:, 1:].ravel(), heights[:, :-1].ravel())[0, 1]) < 0.1
    assert [theirs.geom(g).name for g in (0,)] == ["floor"] and theirs.geom("floor").priority == 1


def test_seeds_differ():
    one, other = (rb.load(rb.envs.rough_ground(XML, points=8, seed=s)) for s in (0, 1))
    assert abs(one.geoms.heights[0] - other.geoms.heights[0]).max() > 0.01


def test_bad_arguments():
    with pytest.raises(rb.ModelError, match="no geom 'ground'"):
        rb.envs.rough_ground(XML, floor="ground")
    with pytest.raises(rb.InputError, match="height"):
        rb.envs.rough_ground(XML, height=0.0)
    with pytest.raises(rb.ModelError, match=r"not well-formed XML .*read_text"):
        rb.envs.rough_ground("robot.xml")
    with pytest.raises(rb.InputError, match="seed"):
        rb.envs.rough_ground(XML, seed=-1)
    with pytest.raises(rb.InputError, match="points"):
        rb.envs.rough_ground(XML, points=1)
