"""Jacobians, their rates, velocities and bias accelerations of bodies, sites and points.

One compiled program for each robot and driver is compared with MuJoCo C (`mj_jac`, `mj_jacSite`,
`mj_jacDot`, `mj_objectVelocity`, `mj_objectAcceleration`) and with derivatives of the pose.
"""

import copy
import functools
import warnings
from typing import Any, NamedTuple

import chex
import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.frames import PATH_UNROLLED_UP_TO
from rbjax.loading import compile_model
from tests.robots import at, load_quietly, robot
from tests.tolerances import F32_MAX, F64_IDENTITY, F64_PARITY, relative_error

POINT = np.array([0.1, -0.2, 0.3])
STATES = 5

# every kind of joint, several on a body; welded bodies, one of them to the world; sites on all
# (no ball with a slide behind it on its body: `mj_jacDot` then differs from the rate of `mj_jac`)
EVERYTHING = """
<mujoco><option gravity="1 2 -9"/><worldbody>
  <site name="ground" pos="1 2 3" euler="10 20 30"/>
  <body name="pole" pos="0.3 0 0" euler="0 40 0"><geom size="0.1"/>
    <site name="top" pos="0 0 1" euler="5 6 7"/>
    <body name="vane" pos="0 0 0.5"><joint name="turn" axis="1 1 0" pos="0.1 0 0"/>
      <geom size="0.1" pos="0.1 0 0"/></body></body>
  <body name="base" pos="0 1 1" euler="20 0 30"><freejoint name="free"/><geom size="0.2"/>
    <body name="box" pos="0.2 0.1 0" euler="0 30 60"><geom type="box" size="0.1 0.2 0.3"/>
      <site name="corner" pos="0.1 0.2 0.3" euler="45 0 10"/></body>
    <body name="left" pos="0.3 0 0"><joint name="reach" type="slide" axis="1 0 2"/>
      <joint name="ball" type="ball" pos="0 0.1 0.1"/><geom size="0.1" pos="0.2 0 0"/>
      <body name="finger" pos="0.3 0.1 0" euler="0 0 50"><joint name="bend" axis="0 1 1"/>
        <joint name="grip" axis="1 0 0" pos="0 0 0.1"/><geom size="0.05" pos="0.1 0 0.1"/>
        <site name="nail" pos="0.1 0 0.1" euler="70 80 90"/></body></body>
    <body name="right" pos="-0.3 0 0"><joint name="swing" axis="0 0 1"/><geom size="0.1"/></body>
  </body>
</worldbody></mujoco>
"""


class Sample(NamedTuple):
    """A model, its reference, and the requested frames, each as (kind, name)."""

    model: rb.Model
    reference: mujoco.MjModel
    frames: tuple[tuple[str, str], ...]
    q: np.ndarray
    v: np.ndarray


@functools.cache
def sample(name: str) -> Sample:
    if name == "everything":
        reference = compile_model(EVERYTHING)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = load_quietly(reference)
        data = [drawn(reference, seed) for seed in range(STATES)]
        q, v = (np.stack([x[k] for x in data]) for k in (0, 1))
        frames = [("body", "vane"), ("body", "left"), ("body", "box"), ("site", "nail")]
        frames += [("site", "top"), ("site", "ground")]
    else:
        model, reference = robot(name).model, robot(name).reference
        q, v = robot(name).states(STATES)
        frames = [("body", model.body_names[-1]), *(("site", s) for s in model.site_names[-1:])]
    return Sample(model, reference, tuple(frames), q, v)


def drawn(reference: mujoco.MjModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, q = np.random.default_rng(seed), np.zeros(reference.nq)
    mujoco.mj_integratePos(reference, q, rng.normal(size=reference.nv), 1.0)
    q += rng.normal(size=reference.nq)
    mujoco.mj_normalizeQuat(reference, q)
    return q, rng.normal(size=reference.nv)


def answers(model: rb.Model, frames: Any, point: Any, q: jax.Array, v: jax.Array) -> Any:
    """All four functions for each frame."""

    def of(kind, name):
        how = {kind: name, "point": point}
        return {
            "J": rb.jacobian(model, q, **how),
            "J'": rb.jacobian_rate(model, q, v, **how),
            "velocity": rb.frame_velocity(model, q, v, **how),
            "J' v": rb.frame_bias_acceleration(model, q, v, **how),
        }

    return [of(*frame) for frame in frames]


def reference_answers(s: Sample, q: np.ndarray, v: np.ndarray, frame: tuple[str, str]) -> Any:
    """MuJoCo's, at the frame's origin; and its Jacobian and rate at `POINT`."""
    kind, name = frame
    m = copy.copy(s.reference)  # which others use too
    m.opt.gravity[:] = 0  # which MuJoCo's accelerations count in
    data = at(m, q, v)
    data.qacc[:] = 0
    mujoco.mj_rnePostConstraint(m, data)
    if kind == "site":
        i, obj = s.model.site(name), mujoco.mjtObj.mjOBJ_SITE
        R, p, body = data.site_xmat[i], data.site_xpos[i], m.site_bodyid[i]
    else:
        i, obj = s.model.body(name) + 1, mujoco.mjtObj.mjOBJ_XBODY
        R, p, body = data.xmat[i], data.xpos[i], i
    out: dict[str, np.ndarray] = {"velocity": np.zeros(6), "J' v": np.zeros(6)}
    mujoco.mj_objectVelocity(m, data, obj, i, out["velocity"], 0)
    mujoco.mj_objectAcceleration(m, data, obj, i, out["J' v"], 0)
    moved = p + R.reshape(3, 3) @ POINT
    for where, place in (("", p), (" at the point", moved)):
        for key, f in (("J", mujoco.mj_jac), ("J'", mujoco.mj_jacDot)):
            linear, angular = np.zeros((2, 3, m.nv))
            f(m, data, linear, angular, place, body)
            out[key + where] = np.concatenate([angular, linear])
    if kind == "site":
        linear, angular = np.zeros((2, 3, m.nv))
        mujoco.mj_jacSite(m, data, linear, angular, i)
        np.testing.assert_allclose(np.concatenate([angular, linear]), out["J"], atol=1e-12)
    return out


CASES = [  # robot, driver, whether the model is an argument of the program
    ("everything", "unrolled", False),
    pytest.param("everything", "rolled", True, marks=pytest.mark.slow),
    ("quadruped", "limbs", False),
    ("pendulum", "rolled", False),
    pytest.param("everything", "rolled", False, marks=pytest.mark.slow),
    pytest.param("arm7", "rolled", False, marks=pytest.mark.slow),
    pytest.param("tree:2", "rolled", False, marks=pytest.mark.slow),
    pytest.param("tree:5", "limbs", False, marks=pytest.mark.slow),
    pytest.param("humanoid", "limbs", False, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "driver", "argument"), CASES)
def test_mujoco(name: str, driver: str, argument: bool) -> None:
    s = sample(name)
    model = s.model.replace(driver=driver)

    points = np.stack([np.zeros(3), POINT])

    def each(model, q, v):
        return jax.vmap(lambda point: answers(model, s.frames, point, q, v))(points)

    if argument:
        mapped = jax.jit(jax.vmap(each, (None, 0, 0)))
        found = mapped(model, s.q, s.v)
    else:
        mapped = jax.jit(jax.vmap(functools.partial(each, model)))
        found = mapped(s.q, s.v)
    for frame, got in zip(s.frames, found, strict=True):
        for k in range(STATES):
            want = reference_answers(s, s.q[k], s.v[k], frame)
            at_point = [want[key + " at the point"] for key in ("J", "J'")]
            twist, bias = (x @ s.v[k] for x in at_point)
            moved = {"J": at_point[0], "J'": at_point[1], "velocity": twist, "J' v": bias}
            for key, x in got.items():
                assert relative_error(x[k][0], want[key]) <= F64_PARITY, (frame, key)
                assert relative_error(x[k][1], moved[key]) <= F64_PARITY, (frame, key)


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
@pytest.mark.parametrize("frame", [("site", "nail"), ("body", "box"), ("site", "ground")])
def test_derivatives_of_the_definition(driver: str, frame: tuple[str, str]) -> None:
    """V is the rate of the pose, J' v + J a that of V, J' that of J."""
    s = sample("everything")
    model, (kind, name) = s.model.replace(driver=driver), frame
    q, v = s.q[0], s.v[0]
    a = np.random.default_rng(3).normal(size=model.nv)
    how: dict[str, Any] = {kind: name, "point": POINT}

    def pose(q):
        if kind == "site":
            R, p = rb.frame_pose(model, q, site=name)
        else:
            R, p = (x[model.body(name)] for x in rb.forward_kinematics(model, q))
        return R, p + R @ POINT

    def along(t):
        moved, speed = rb.integrate(model, q, v * t), v + a * t
        twist = rb.frame_velocity(model, moved, speed, **how)
        return pose(moved), twist, rb.jacobian(model, moved, **how)

    @jax.jit
    def both():
        return jax.jvp(along, (0.0,), (1.0,)), answers(model, [frame], POINT, q, v)[0]

    (((R, _), _, J), ((R_rate, p_rate), acceleration, J_rate)), got = both()
    W = R_rate @ R.T
    chex.assert_shape([J, J_rate], (6, model.nv))
    twist = np.r_[W[2, 1], W[0, 2], W[1, 0], p_rate]
    assert relative_error(got["velocity"], twist) <= F64_IDENTITY
    assert relative_error(got["J' v"] + J @ a, acceleration) <= F64_IDENTITY
    assert relative_error(got["J'"], J_rate) <= F64_IDENTITY
    if name == "ground":
        assert not np.any(J) and not np.any(got["velocity"]) and not np.any(got["J' v"])


def test_f32() -> None:
    s = sample("everything")

    def mapped(dtype):
        q, v = s.q.astype(dtype), s.v.astype(dtype)
        f = functools.partial(answers, s.model, s.frames[-3:-2], POINT)  # the point follows
        return jax.jit(jax.vmap(f))(q, v)

    single, double = mapped(np.float32), mapped(np.float64)
    chex.assert_trees_all_equal_shapes(single, double)
    for got, want in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert got.dtype == np.float32
        assert relative_error(got, want, batch_dims=1).max() <= F32_MAX


def test_structure_costs_nothing() -> None:
    """If the model is closed over, links that do not move the frame are not computed."""
    model = rb.load("double_pendulum").replace(driver="unrolled")
    q, v = model.default_state().q, model.default_state().v
    upper = rb.operation_count(lambda q, v: rb.frame_velocity(model, q, v, "upper"), q, v)
    lower = rb.operation_count(lambda q, v: rb.frame_velocity(model, q, v, "lower"), q, v)
    assert upper.total == 0 < lower.total  # it turns about its own origin


ASK = (
    rb.frame_pose, rb.jacobian, rb.jacobian_rate, rb.frame_velocity, rb.frame_bias_acceleration,
)  # fmt: skip


@pytest.mark.parametrize("function", ASK)
def test_what_is_refused(function: Any) -> None:
    model = robot("small").model
    state = model.default_state()
    at_rest = function in (rb.frame_pose, rb.jacobian)
    given = (model, state.q) if at_rest else (model, state.q, state.v)
    name = function.__name__
    with pytest.raises(rb.InputError, match=f"{name}: got neither of body and site"):
        function(*given)
    with pytest.raises(rb.InputError, match=f"{name}: got both of body and site"):
        function(*given, "hand", site="tip")
    with pytest.raises(rb.InputError, match=r"body is ndarray, .* one of model.body_names"):
        function(*given, np.zeros(3))
    with pytest.raises(rb.InputError, match=r"point has shape \(2,\), expected \(3,\)"):
        function(*given, "hand", np.zeros(2))
    with pytest.raises(rb.InputError, match=r"point\[1\] is nan"):
        function(*given, "hand", point=np.array([0, np.nan, 0]))
    with pytest.raises(rb.UnknownName, match=r"unknown site 'hand'.*'tip'"):
        function(*given, site="hand")


def test_a_point_may_follow_the_body() -> None:
    model = robot("small").model
    q = model.default_state().q
    here = rb.jacobian(model, q, "hand", POINT)
    chex.assert_trees_all_equal(here, rb.jacobian(model, q, body="hand", point=POINT))
    origin = rb.jacobian(model, q, "hand")
    chex.assert_trees_all_equal(origin, rb.jacobian(model, q, "hand", point=np.zeros(3)))
    assert np.abs(here - origin).max() > 0.1


def test_a_ball_with_a_slide_behind_it() -> None:
    """Its axes turn with its body, its centre stays where the slide begins."""
    model = rb.load(
        """<mujoco><worldbody><body name="b"><joint type="ball" pos="0 0.1 0.1"/>
        <joint type="slide" axis="1 0 2"/><geom size="0.1"/></body></worldbody></mujoco>"""
    )
    q, v = np.array([0.5, 0.5, -0.1, 0.7, 0.3]), np.array([1.0, -2.0, 0.5, 0.8])

    def along(t):
        return rb.jacobian(model, rb.integrate(model, q, v * t), "b")

    rate = jax.jvp(along, (0.0,), (1.0,))[1]
    assert relative_error(rb.jacobian_rate(model, q, v, "b"), rate) <= F64_IDENTITY


CHAIN = "<mujoco><worldbody>{}<site name='end' pos='0 0 1'/>{}</worldbody></mujoco>".format(
    "".join(f"<body name='{i}' pos='0 .1 .2'><joint axis='{i % 2} 1 0'/><inertial pos='0 0 0' "
            "mass='1' diaginertia='1 1 1'/>" for i in range(PATH_UNROLLED_UP_TO + 2)),
    "</body>" * (PATH_UNROLLED_UP_TO + 2),
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "driver"),
    [
        pytest.param("humanoid", "rolled", marks=pytest.mark.slow),
        ("quadruped", "limbs"),
        pytest.param("arm7", "unrolled", marks=pytest.mark.slow),
        (CHAIN, "rolled"),
    ],
    ids=["humanoid", "quadruped", "arm7", "chain"],
)
def test_the_pose_of_a_site_asks_for_its_path_alone(name: str, driver: str) -> None:
    """It is the body's pose times the site's, with less arithmetic than for all bodies."""
    model = load_quietly(name).replace(driver=driver)
    q = model.random_state(jax.random.key(1)).q
    site = len(model.site_names) - 1
    body = model.topology.site_bodies[site]

    @jax.jit
    def both(model, q):
        poses = rb.forward_kinematics(model, q)
        return rb.frame_pose(model, q, site=model.site_names[site]), (poses.R[body], poses.p[body])

    (R, p), (E, o) = both(model, q)
    own = rb.rotations.quaternion.to_matrix(model.sites.orientation[site])
    assert relative_error(R, E @ own) <= F64_IDENTITY
    assert relative_error(p, o + E @ model.sites.position[site]) <= F64_IDENTITY
    asked = rb.operation_count(
        lambda m, q: rb.frame_pose(m, q, site=model.site_names[site]), model, q
    )
    every = rb.operation_count(rb.forward_kinematics, model, q)
    least = {"arm7": 1.1, CHAIN: 1.1}.get(name, 1 / 3)  # they have one path, and all bodies on it
    assert asked.total < least * every.total


def test_the_pose_of_a_point_of_a_body_or_site() -> None:
    """A point moves p and leaves R; the world and what is welded to it stay."""
    model = sample("everything").model
    q = sample("everything").q[0]

    @jax.jit
    def found(q):
        of_bodies = [rb.frame_pose(model, q, body, POINT) for body in model.body_names]
        sites = [(rb.frame_pose(model, q, site=s), rb.frame_pose(model, q, None, POINT, site=s))
                 for s in model.site_names]  # fmt: skip
        return of_bodies, sites, rb.frame_pose(model, q, "world", POINT)

    of_bodies, sites, (R, p) = found(q)
    poses = rb.forward_kinematics(model, q)
    for i, (R_body, p_body) in enumerate(of_bodies):
        assert relative_error(R_body, poses.R[i]) <= F64_IDENTITY
        assert relative_error(p_body, poses.p[i] + poses.R[i] @ POINT) <= F64_IDENTITY
    for (R_site, origin), (same, p_site) in sites:
        chex.assert_trees_all_equal(R_site, same)
        assert relative_error(p_site, origin + R_site @ POINT) <= F64_IDENTITY
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(p, POINT)


def test_frames_as_values() -> None:
    """`rb.Frame` in place of a body gives the results of its parts, and excludes them."""
    model = robot("small").model
    q, v = model.keyframe("bent").q, model.keyframe("bent").v
    point = np.array([0.1, -0.2, 0.3])
    for parts in ({"body": "hand", "point": point}, {"site": "tip"}):
        frame = rb.Frame(**parts)
        for f, given in ((rb.frame_pose, (q,)), (rb.jacobian, (q,)), (rb.frame_velocity, (q, v))):
            got, want = (
                jax.tree.leaves(x) for x in (f(model, *given, frame), f(model, *given, **parts))
            )
            for a, b in zip(got, want, strict=True):
                np.testing.assert_array_equal(a, b)
    with pytest.raises(rb.InputError, match="jacobian: got a Frame and site"):
        rb.jacobian(model, q, rb.Frame("hand"), site="tip")
