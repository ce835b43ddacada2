"""Stops against MuJoCo's at rest under load; that they only push, smoothly, and gain no energy."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.joints.limits import stop_energy, stop_force
from tests.forces.against_mujoco import AT_A_JUMP, applied, costs_nothing, slopes
from tests.robots import load_quietly
from tests.tolerances import F64_IDENTITY

STOPPED = """
<mujoco><compiler angle="radian"/><option gravity="0 0 0"/>
<default><geom contype="0" conaffinity="0" size="0.1" pos="0.3 0 0.1"/></default><worldbody>
<body><joint name="j" type="{kind}" axis="0 1 0" limited="true" range="{range}" {more}/>
  <geom/></body>
</worldbody></mujoco>
"""
ARM = """
<mujoco><compiler angle="radian"/>
<default><geom contype="0" conaffinity="0" size="0.1" pos="0.1 0 0.05"/>
  <joint limited="true"/></default>
<worldbody>
  <body><joint name="hinge" axis="0 1 0" range="-0.3 0.4" margin="0.05"/><geom/>
    <body pos="0.2 0 0"><joint name="slide" type="slide" axis="1 1 0" range="-0.1 0.1"/><geom/>
      <body pos="0.2 0 0"><joint name="ball" type="ball" range="0 0.7"/><geom/></body></body></body>
  <body><freejoint/><geom/></body>
</worldbody></mujoco>
"""
STOP = (1000.0, 20.0, 0.05)  # k, d, w


def load(kind: str, more: str) -> tuple[mujoco.MjModel, rb.Model, float]:
    """A joint with a stop at 0.5; the model in both, and where the stop begins."""
    text = STOPPED.format(kind=kind, range="0 0.5" if kind == "ball" else "-1 0.5", more=more)
    m = mujoco.MjModel.from_xml_string(text)
    return m, load_quietly(m, limits=True), 0.5 - m.jnt_margin[0]


def at(m: mujoco.MjModel, x: np.ndarray) -> np.ndarray:
    """Configurations at the coordinates x (n,); of a ball, turned about y."""
    if m.nq == 1:
        return x[:, None]
    zero = np.zeros_like(x)
    return np.stack([np.cos(x / 2), zero, np.sin(x / 2), zero], -1)


def rest(push, load: float) -> float:
    """The depth at which the force of a stop, push(depth), equals a load."""
    low, high = 0.0, 0.4
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if push(middle) < load else (low, middle)
    return low


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("hinge", ""),
        ("slide", ""),
        ("ball", ""),
        ("hinge", 'margin="0.1"'),
        ("ball", 'margin="0.1"'),
        ("hinge", 'solreflimit="0.05 0.7"'),
        ("slide", 'solreflimit="-3000 -40"'),
    ],
)
def test_depth_at_rest_under_load_as_of_mujoco(kind: str, more: str) -> None:
    """Within a factor of 1.75, where the load alone would accelerate the joint by 3 to 300 rad/s^2
    or m/s^2: MuJoCo's stop becomes 2.2 times as stiff over its width, and ours is between."""
    m, model, begin = load(kind, more)
    depths = np.geomspace(1e-5, 0.1, 400)
    q = at(m, begin + depths)
    v = np.zeros((len(q), m.nv))
    ours = -np.asarray(applied(model)(q, v, np.zeros((len(q), 0))))[:, m.nv // 2]
    data, factors = mujoco.MjData(m), []
    for accel in (3.0, 30.0, 300.0):
        load_ = accel / m.dof_invweight0[0]

        def push(depth: float) -> float:
            data.qpos, data.qvel = at(m, np.array([begin + depth]))[0], 0
            data.qfrc_applied[m.nv // 2] = load_  # noqa: B023
            mujoco.mj_forward(m, data)
            return load_ + (1.0 if data.qacc[m.nv // 2] < 0 else -1.0)  # noqa: B023

        factors.append(np.interp(load_, ours, depths) / rest(push, load_))
    assert np.all(np.array(factors) > 1 / 1.75) and np.all(np.array(factors) < 1.75), factors
    assert ours.min() >= 0 and not np.any(
        applied(model)(at(m, np.linspace(0.0, begin - 1e-9, 9)), v[:9], np.zeros((9, 0)))
    )


def test_only_where_asked_for_and_enabled() -> None:
    model = load_quietly(ARM, limits=True)
    assert not any("limits" in word for word in model.dropped)
    assert len(model.forces) == 1 and model.forces[0].joints == (0, 1, 2)
    assert load_quietly(ARM).forces == ()
    free = load_quietly(ARM, contacts=False)
    assert any("joint limits" in word for word in free.dropped) and free.forces == ()
    for flag in ("limit", "constraint"):
        off = ARM.replace("<default>", f'<option><flag {flag}="disable"/></option><default>', 1)
        assert rb.load(off, limits=True).forces == ()
    assert rb.load("double_pendulum", limits=True).forces == ()


def test_the_law() -> None:
    """It pushes and never pulls; its damper takes energy; going in it is a spring and a damper."""
    k, d, w = STOP
    p, rate = jnp.meshgrid(jnp.linspace(-0.1, 0.3, 81), jnp.linspace(-90.0, 90.0, 61))
    f = stop_force(p, rate, k, d, w)
    assert np.all(f >= 0) and not np.any(f[p <= 0]) and np.all(f[p > 0] > 0)
    still = stop_force(p, 0 * rate, k, d, w)
    assert np.all((f - still) * rate >= 0)
    deep = (p > w) & (rate > 0)
    np.testing.assert_allclose(f[deep], (k * (p - w / 2) + d * rate)[deep])
    slope = jax.vmap(jax.grad(lambda p: stop_energy(p, k, w)))(p.ravel())
    np.testing.assert_allclose(slope, still.ravel(), rtol=F64_IDENTITY, atol=1e-12)
    at = stop_energy(jnp.array([0.0, w, w * (1 + 1e-12)]), k, w)  # nothing, and one where they meet
    np.testing.assert_allclose(at, [0.0, k * w**2 / 6, k * w**2 / 6], rtol=1e-10)


def test_two_stops_that_are_apart_cost_as_one() -> None:
    """The nearer end's alone is evaluated; where they may act at once, both are: with the same
    forces."""
    text = STOPPED.format(kind="hinge", range="-1 0.5", more="")
    model = load_quietly(text).with_forces(
        rb.forces.JointLimits(*(jnp.array([x]) for x in (1000.0, 20.0, 0.0, 0.05)), ("j",))
    )
    model = model.replace(joints=model.joints.replace(range=jnp.array([[-1.0, 0.5]])))
    wide = model.forces[0].replace(margin=jnp.array([0.8]))  # both begin within the range

    def force(model, q, v):
        return rb.applied_forces(model, rb.State(q, v))[0]

    def both(q, v, margin):
        low = stop_force(-1.0 + margin - q, -v, *STOP)
        return low - stop_force(q - 0.5 + margin, v, *STOP)

    q = jnp.linspace(-1.3, 0.8, 85)
    v = 3 * jnp.cos(40 * q)
    for element, margin in ((model.forces[0], 0.0), (wide, 0.8)):
        changed = model.replace(forces=(element,))
        run = jax.jit(jax.vmap(lambda q, v, m=changed: force(m, q[None], v[None])))
        np.testing.assert_allclose(run(q, v), both(q, v, margin), rtol=F64_IDENTITY, atol=1e-9)
    at = (jnp.array([0.6]), jnp.array([1.0]))
    one = rb.operation_count(force, model, *at).total
    two = rb.operation_count(force, model.replace(forces=(wide,)), *at).total
    assert one < 0.65 * two


@pytest.mark.parametrize("rate", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("p", [0.0, 0.02, STOP[2], 0.2])
def test_the_law_is_once_differentiable(p: float, rate: float) -> None:
    """Slopes from both sides of where its branches meet are one."""
    slope = jax.jit(jax.vmap(jax.grad(lambda p, rate: stop_force(p, rate, *STOP), (0, 1))))
    near = jnp.array([-1e-9, 0.0, 1e-9])
    for a, b in ((p + near, rate + 0 * near), (p + 0 * near, rate + near)):
        for x in slope(a, b):
            np.testing.assert_allclose(x, x[1], rtol=1e-6, atol=1e-2)


def test_slopes_at_the_limits() -> None:
    model = load_quietly(ARM, limits=True)
    k, d, margin, w = jnp.full(3, 10.0), jnp.ones(3), jnp.array([0.05, 0, 0]), jnp.full(3, 0.3)
    soft = rb.forces.JointLimits(k, d, margin, w, ("hinge", "slide", "ball"))

    def f(x):
        element, ends, q, v = x
        changed = model.replace(forces=(element,), joints=model.joints.replace(range=ends))
        return rb.applied_forces(changed, rb.State(q, v))

    q = model.default_state().q
    ball = slice(*model.q_slice("ball").indices(99)[:2])
    turned = jnp.array([np.cos(0.35), 0.0, np.sin(0.35), 0.0])
    bounds = jnp.where(jnp.isfinite(model.joints.range), model.joints.range, 9.0)
    v = jnp.ones(model.nv)
    for x, y, turn, speed in (
        (0.35, -0.1, turned, 0.0),  # where the stops begin
        (0.65, -0.4, turned, 1.0),  # where they have become stiff
        (0.0, 0.0, jnp.array([1.0, 0, 0, 0]), 0.0),
        (-0.4, 0.3, jnp.array([0.3, 0.5, 0.1, 0.7]), -1.0),
    ):
        here = q.at[:2].set(jnp.array([x, y])).at[ball].set(turn)
        assert slopes(f, (soft, bounds, here, speed * v)) < AT_A_JUMP


def test_a_fall_onto_a_stop_gains_no_energy() -> None:
    text = STOPPED.format(kind="hinge", range="-1 0.5", more="").replace('"0 0 0"', '"0 0 -9"')
    model = load_quietly(text, limits=True)
    state = model.default_state().replace(q=jnp.array([-0.5]))
    path = rb.rollout(model, state, steps=4000, dt=2.5e-4, integrator="rk4")

    @jax.jit
    @jax.vmap
    def energy(q, v):
        moving = rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q)
        return moving + rb.forces.elastic_energy(model, q)

    found = np.asarray(energy(path.q, path.v))
    assert np.diff(found).max() < 1e-6 * np.ptp(found)
    assert np.ptp(found) > 0.1 and 0.5 < path.q[-1, 0] < 0.51 and abs(path.v[-1, 0]) < 1e-3


def test_no_stiffness_costs_nothing() -> None:
    model = load_quietly(ARM)
    three = jnp.zeros(3)
    none = rb.forces.JointLimits(three, three, three, three + 1, ("hinge", "slide", "ball"))
    assert costs_nothing(none, model)
    free = rb.forces.JointLimits(*(jnp.ones(1),) * 4, (3,))
    with pytest.raises(rb.InputError, match="a free joint has no range"):
        rb.applied_forces(model.with_forces(free), model.default_state())
