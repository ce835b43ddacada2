"""Inverse kinematics against forward kinematics, MuJoCo C, closed forms and central differences."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
import rbjax.control
from rbjax.errors import InputError, UnknownName
from rbjax.kinematics.joint_ranges import Ranges, random_configurations
from tests.control.arms import ARM, arm7
from tests.robots import load_quietly

ik = rb.control.inverse_kinematics
Goal = rb.control.Goal

# a planar arm of two unit links in the x-z plane, whose elbow bends one way only
PLANAR = """
<mujoco><compiler angle="radian"/><worldbody><body name="upper">
<joint name="shoulder" axis="0 -1 0" range="-3 3"/>
<geom size="0.1"/><body name="lower" pos="1 0 0"><joint name="elbow" axis="0 -1 0" range="0.2 2.8"/>
<geom size="0.1"/><site name="hand" pos="1 0 0"/></body></body></worldbody></mujoco>
"""
# a floating trunk with a leg on a ball joint of limited swing and a knee, and an arm
FLOATING = """
<mujoco><compiler angle="radian"/><worldbody><body name="trunk"><freejoint/><geom size="0.2"/>
<body name="thigh" pos="0 0 -0.2"><joint name="hip" type="ball" range="0 0.6"/><geom size="0.1"/>
<body name="shin" pos="0 0 -0.4"><joint name="knee" axis="0 1 0" range="0 2"/><geom size="0.1"/>
<site name="foot" pos="0 0 -0.4"/></body></body>
<body name="arm" pos="0.2 0 0.1"><geom size="0.1"/>
<joint name="reach" type="slide" axis="1 0 0" range="0 0.5"/>
<site name="hand" pos="0.1 0 0"/></body></body></worldbody></mujoco>
"""
CONFIGURATION = np.array([0.3, 0.4, -0.5, 1.0, 0.6, 1.0, 0.2])


@pytest.fixture(scope="module")
def arm():
    return arm7()


@pytest.fixture(scope="module")
def planar():
    return load_quietly(PLANAR)


def within(model, q):
    return all((q[b.q] >= b.lower) & (q[b.q] <= b.upper) for b in Ranges(model, q.dtype).bounded)


def test_planar_arm_has_the_closed_form(planar):
    """Two links of length one: the law of cosines, with the elbow that the range allows."""
    x, z = 0.7, 0.9
    found = ik(planar, [x, 0.0, z], site="hand")
    elbow = np.arccos((x * x + z * z - 2) / 2)
    shoulder = np.arctan2(z, x) - np.arctan2(np.sin(elbow), 1 + np.cos(elbow))
    assert found.summary().startswith("converged")
    np.testing.assert_allclose(found.q, [shoulder, elbow], atol=2e-6)


def test_out_of_reach_is_the_closest_pose(planar):
    """A point 3 m away: the straightest arm that the elbow's range allows points to it."""
    found = ik(planar, [3.0, 0.0, 0.0], site="hand", seeds=4)
    assert not found.success and "closest pose" in found.summary()
    assert found.q[1] == 0.2  # the end of its range, exactly
    reach = np.hypot(1 + np.cos(0.2), np.sin(0.2))
    assert abs(float(found.position_error) - (3 - reach)) < 1e-6


def test_pose_against_mujoco(arm):
    """The pose that MuJoCo computes from the answer is the one that was asked for."""
    m = mujoco.MjModel.from_xml_path(str(scene("arm7")))
    data = mujoco.MjData(m)
    R, p = rb.frame_pose(arm, jnp.asarray(CONFIGURATION), site="tool")
    found = ik(arm, (R, p), site="tool")
    assert found.success and within(arm, found.q)
    data.qpos[:] = found.q
    mujoco.mj_forward(m, data)
    np.testing.assert_allclose(data.site("tool").xpos, p, atol=1e-6)
    np.testing.assert_allclose(data.site("tool").xmat.reshape(3, 3), R, atol=2e-6)


def scene(name):
    from pathlib import Path

    return Path(rb.__file__).parent / "loading/scenes" / f"{name}.xml"


def test_direction(arm):
    found = ik(arm, Goal(site="tool", position=[0.5, 0.1, 0.5], direction=[0.0, 0.0, -2.0]))
    R, p = rb.frame_pose(arm, found.q, site="tool")
    assert found.success
    np.testing.assert_allclose(R[:, 2], [0.0, 0.0, -1.0], atol=2e-6)
    np.testing.assert_allclose(p, [0.5, 0.1, 0.5], atol=1e-6)


def test_several_frames_free_and_ball_joints():
    """A foot and a hand of a floating robot; the hip's swing and the slide stay in their ranges."""
    model = load_quietly(FLOATING)
    q = random_configurations(model, jax.random.key(3), 1, model.default_state().q)[0]
    (Rf, pf), (Rh, ph) = (rb.frame_pose(model, q, site=s) for s in ("foot", "hand"))
    goals = [
        Goal(site="foot", position=pf, rotation=Rf),
        Goal(site="hand", position=ph, rotation=Rh),
    ]
    found = ik(model, goals)
    assert found.success, found.summary()
    for site, (R, p) in (("foot", (Rf, pf)), ("hand", (Rh, ph))):
        got = rb.frame_pose(model, found.q, site=site)
        np.testing.assert_allclose(got[1], p, atol=2e-6)
        np.testing.assert_allclose(got[0], R, atol=4e-6)
    angle = rb.rotations.quaternion.angle(found.q[model.q_slice("hip")])
    assert angle <= 0.6 + 1e-12 and within(model, found.q)
    assert abs(np.linalg.norm(found.q[3:7]) - 1) < 1e-14


def test_ball_joint_at_the_end_of_its_swing():
    """A pendulum on a ball joint that may swing 0.6 rad, asked for 1.2 rad: it stops at 0.6."""
    model = load_quietly(
        '<mujoco><compiler angle="radian"/><worldbody><body name="b">'
        '<joint type="ball" range="0 0.6"/><geom size="0.1"/><site name="tip" pos="0 0 -1"/>'
        "</body></worldbody></mujoco>"
    )
    found = ik(model, [np.sin(1.2), 0.0, -np.cos(1.2)], site="tip", seeds=2)
    _, p = rb.frame_pose(model, found.q, site="tip")
    assert not found.success
    np.testing.assert_allclose(p, [np.sin(0.6), 0.0, -np.cos(0.6)], atol=1e-6)


def test_posture_is_the_nearest_solution(arm):
    """At the answer, the way to the posture has no part in the null space of J (first-order
    conditions of the least |p - q|^2); random solutions nearby are farther."""
    R, p = rb.frame_pose(arm, jnp.asarray(CONFIGURATION), site="tool")
    posture = jnp.asarray(CONFIGURATION + 0.3)
    found = ik(arm, (R, p), site="tool", posture=posture, start=CONFIGURATION, tolerance=1e-9)
    assert found.success
    J = np.asarray(rb.jacobian(arm, found.q, site="tool"))
    null = np.linalg.svd(J)[2][6]
    assert abs(null @ (posture - found.q)) < 1e-8
    assert np.linalg.norm(posture - found.q) < np.linalg.norm(posture - CONFIGURATION)


@pytest.mark.slow
def test_derivatives_by_target_posture_and_model():
    """Reverse and forward derivatives of the solution against central differences of searches."""
    arm, q0 = load_quietly(ARM), jnp.array([0.2, -0.6, 1.2, 0.4])
    _, p = rb.frame_pose(arm, q0, site="tip")

    def f(p, posture, position):
        model = arm.replace(bodies=arm.bodies.replace(position=position))
        found = ik(model, p, site="tip", posture=posture, start=q0, seeds=1, tolerance=1e-11,
                   iterations=100)  # fmt: skip
        return found.q

    at = p, q0 + 0.2, arm.bodies.position
    rng = np.random.default_rng(0)
    by = [jnp.asarray(rng.normal(size=x.shape)) for x in at]
    w = jnp.asarray(rng.normal(size=4))

    def everything(at, by):
        h = 1e-5
        ends = [f(*(x + s * h * t for x, t in zip(at, by, strict=True))) for s in (1, -1)]
        rate = jax.jvp(f, tuple(at), tuple(by))[1]
        back = jax.vjp(f, *at)[1](w)
        return (ends[0] - ends[1]) / (2 * h), rate, back

    difference, rate, back = jax.jit(everything)(at, by)
    scale = np.abs(rate).max()
    assert np.abs(difference - rate).max() <= 1e-6 * scale
    assert abs(sum(jnp.vdot(b, t) for b, t in zip(back, by, strict=True)) - w @ rate) < 1e-9 * scale


def test_derivative_without_posture_is_the_pseudoinverse(arm):
    R, p = rb.frame_pose(arm, jnp.asarray(CONFIGURATION), site="tool")
    J, q = jax.jit(lambda p: (jax.jacfwd(lambda p: ik(arm, (R, p), site="tool").q)(p),
                              ik(arm, (R, p), site="tool").q))(p)  # fmt: skip
    want = np.linalg.pinv(np.asarray(rb.jacobian(arm, q, site="tool")))[:, 3:]
    np.testing.assert_allclose(J, want, atol=1e-5)


def test_batch_is_a_loop_and_side_by_side_agrees(planar):
    targets = jnp.asarray([[0.7, 0.0, 0.9], [1.2, 0.0, -0.3], [0.2, 0.0, 0.8]])
    f = lambda p: ik(planar, p, site="hand", seeds=8)  # noqa: E731
    mapped = jax.jit(jax.vmap(f))(targets)
    for i, p in enumerate(targets):
        one = f(p)
        np.testing.assert_allclose(mapped.q[i], one.q, atol=1e-10)
        beside = ik(planar, p, site="hand", seeds=8, side_by_side=4)
        assert beside.success
        np.testing.assert_allclose(beside.q, one.q, atol=2e-6)
    assert mapped.summary() == "converged: all 3"


def test_never_nan(planar):
    """A traced target of NaN, and singular starts, end with finite configurations."""
    found = jax.jit(lambda p: ik(planar, p, site="hand", seeds=2))(jnp.full(3, jnp.nan))
    assert not found.success and np.isfinite(found.q).all()
    straight = ik(planar, [0.0, 0.0, 0.0], site="hand", limits=False, start=[0.0, 0.0], seeds=3)
    assert np.isfinite(straight.q).all()


def test_bad_arguments(planar):
    cases = [
        (dict(target=[1.0, 0.0]), "target has shape"),
        (dict(target=[1.0, 0.0, 0.0], site=None), "neither"),
        (dict(target=[1.0, 0.0, 0.0], seeds=0), "seeds"),
        (dict(target=(2 * np.eye(3), np.zeros(3))), "not a rotation matrix"),
        (dict(target=[1.0, 0.0, 0.0], start=[0.0]), "start has shape"),
        (dict(target=[1.0, 0.0, 0.0], tolerance=-1.0), "above zero"),
        (dict(target=[Goal(site="hand", position=[1.0, 0.0, 0.0])]), "own frames"),
        (dict(target=[1.0, np.nan, 0.0]), "finite"),
    ]
    for given, message in cases:
        with pytest.raises(InputError, match=message):
            ik(planar, **({"site": "hand"} | given))
    with pytest.raises(UnknownName):
        ik(planar, [1.0, 0.0, 0.0], site="foot")
    with pytest.raises(InputError, match="no joint moves"):
        ik(load_quietly("arm7"), [1.0, 0.0, 0.0], body="base")
    with pytest.raises(InputError, match="both rotation and direction"):
        Goal(site="hand", rotation=np.eye(3), direction=[1.0, 0.0, 0.0])


@pytest.mark.slow
def test_a_thousand_reachable_poses(arm):
    """1,000 poses of random configurations within the ranges: at least 99.9 % to 1e-6."""
    model = arm
    q = random_configurations(model, jax.random.key(5), 1000, model.default_state().q)
    R, p = jax.jit(jax.vmap(lambda q: rb.frame_pose(model, q, site="tool")))(q)
    found = jax.jit(jax.vmap(lambda R, p: ik(model, (R, p), site="tool")))(R, p)
    Rf, pf = jax.jit(jax.vmap(lambda q: rb.frame_pose(model, q, site="tool")))(found.q)
    solved = (jnp.linalg.norm(pf - p, axis=1) <= 1.01e-6) & (jnp.abs(Rf - R).max((1, 2)) <= 1.5e-6)
    low, high = model.joints.range.T
    assert ((found.q >= low) & (found.q <= high)).all()
    assert solved.mean() >= 0.999
