"""The sensors of robot files against MuJoCo's sensordata, and how they are read."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import Gyro, JointPosition, NamedSensor, Velocities
from tests.sensors.equipped import loaded, random_motion, rich, sensed_by_mujoco, tree
from tests.tolerances import F32_MAX, F64_PARITY, relative_error

OFF = mujoco.mjtDisableBit
ROUNDING = 0.01  # a smaller reading is compared as though it were that large: zeros by cancellation


def without(m, *flags):
    for flag in flags:
        m.opt.disableflags |= int(flag)
    m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    return m


def compare(m, model, seed, tolerance=F64_PARITY, kinds=()):
    """Compare all readings with MuJoCo's; return the readings by kind."""
    state, ctrl = random_motion(model, seed, m.nu)
    ours = rb.sense(model, state, ctrl, t=0.3, named=True)
    theirs, _ = sensed_by_mujoco(m, state, ctrl)
    compared = {}
    for name, value in ours.items():
        kind = mujoco.mjtSensor(int(m.sensor(name).type[0])).name[7:]
        if kinds and kind not in kinds:
            continue
        wrong = relative_error(value, theirs[name], floor=ROUNDING)
        assert wrong < tolerance, (kind, name, value, theirs[name])
        compared.setdefault(kind, []).append(value)
    return compared


def test_some_sensors_of_a_tree_read_as_mujoco():
    check_tree(1, 8)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_sensors_of_a_tree_read_as_mujoco(seed):
    compared = check_tree(seed, 3 if seed == 2 else 1)
    assert {"FORCE", "TORQUE", "FRAMEQUAT", "FRAMELINVEL", "E_POTENTIAL"} <= compared.keys()


def check_tree(seed, every):
    """Frames of bodies, sites, geoms and cameras, joints, actuators and subtrees; forces between
    bodies, welded ones among them."""
    m = tree(seed, every)
    model = loaded(m)
    assert [s.name for s in model.sensors] == [m.sensor(i).name for i in range(m.nsensor)]
    without(m, OFF.mjDSBL_LIMIT, OFF.mjDSBL_FRICTIONLOSS, OFF.mjDSBL_EQUALITY)
    return compare(m, model, seed)


#: kinds of the robot of rich.xml in the quick test
OTHER = [
    "RANGEFINDER",
    "INSIDESITE",
    "CAMPROJECTION",
    "MAGNETOMETER",
    "TENDONPOS",
    "TENDONVEL",
    "TENDONACTFRC",
    "ACTUATORPOS",
    "ACTUATORVEL",
    "ACTUATORFRC",
    "JOINTACTFRC",
    "BALLQUAT",
    "BALLANGVEL",
    "GYRO",
    "TOUCH",
    "CLOCK",
]


def test_actuators_tendons_rays_and_volumes_read_as_mujoco():
    m = rich(*OTHER)
    model = loaded(m)
    without(m, OFF.mjDSBL_LIMIT, OFF.mjDSBL_CONTACT)
    found = [compare(m, model, seed) for seed in range(6)]
    assert all(x.keys() == {*OTHER} for x in found)
    hits = [float(value[0]) for x in found for value in x["RANGEFINDER"]]
    assert min(hits) == -1 and sum(x > 0 for x in hits) >= 10  # some rays hit, others do not


LIMITS = ["JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL"]


def test_limits_read_as_mujoco():
    """Near both ends, beyond them, and far from them."""
    m = rich(*LIMITS)
    model = loaded(m)
    found = [compare(m, model, seed) for seed in range(12)]
    for kind in LIMITS:
        near = [float(value[0]) != 0 for x in found for value in x[kind]]
        assert any(near) and not all(near)


def test_single_precision():
    m = tree(1, 13)
    model = loaded(m)
    state, ctrl = random_motion(model, 3, m.nu)
    want = rb.sense(model, state, ctrl, named=True)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (model, state, ctrl))
    for name, value in rb.sense(*single, named=True).items():
        assert value.dtype == jnp.float32
        assert relative_error(value, want[name], floor=0.1) < F32_MAX


def small(*sensors):
    return rb.load("two_link").replace(sensors=sensors)


def test_names_cutoff_noise_and_order():
    model = small(
        NamedSensor("spin", Gyro("tip"), cutoff=0.5),
        NamedSensor("angle", JointPosition("joint2"), noise=0.3),
    )
    state = rb.State(jnp.array([0.1, 0.2]), jnp.array([1.0, -3.0]))
    values = rb.sense(model, state)
    assert values.shape == (4,) and values[3] == 0.2
    assert abs(values).max() == 0.5
    named = rb.sense(model, state, named=True)
    assert [*named] == ["spin", "angle"]
    np.testing.assert_array_equal(jnp.concatenate([*named.values()]), values)
    assert rb.sense(small(), state).shape == (0,)


def test_a_trajectory_is_read_at_its_times():
    model = small(NamedSensor("v", Velocities()), NamedSensor("a", rb.sensors.Accelerations()))
    state = rb.State(jnp.array([0.1, 0.2]), jnp.array([1.0, -3.0]))
    ctrls = jnp.sin(jnp.arange(6.0)).reshape(3, 2)
    path = rb.rollout(model, state, ctrls, 0.01)
    seen = rb.sense(model, path, ctrls)
    assert seen.shape == (4, 4)
    one = rb.sense(model, path.state(1), ctrls[1], t=path.ts[1])
    np.testing.assert_allclose(seen[1], one, rtol=1e-12)
    np.testing.assert_allclose(
        seen[3], rb.sense(model, path.state(3), ctrls[2]), rtol=1e-12
    )  # the last row of the controls is repeated
    both = rb.rollout(model, jax.tree.map(lambda x: jnp.stack([x, x]), state), ctrls, 0.01)
    batch = rb.sense(model, both, jnp.stack([ctrls, ctrls]), named=True)
    np.testing.assert_allclose(batch["a"][1], seen[:, 2:], rtol=1e-12)
    policy = lambda t, s: -s.v  # noqa: E731
    seen = rb.sense(model, path, policy)
    np.testing.assert_allclose(seen[2], rb.sense(model, path.state(2), -path.v[2]), rtol=1e-12)


def test_a_policy_reads_sensors_in_a_rollout():
    model = small(NamedSensor("angle", JointPosition("joint1")))
    state = rb.State(jnp.array([0.1, 0.2]), jnp.array([1.0, -3.0]))
    measured = rb.rollout(
        model, state, lambda t, s: -rb.sense(model, s) * jnp.ones(2), 0.01, steps=5
    )
    known = rb.rollout(model, state, lambda t, s: -s.q[:1] * jnp.ones(2), 0.01, steps=5)
    np.testing.assert_allclose(measured.q, known.q, rtol=1e-12)


def test_readings_in_threads():
    model = small(NamedSensor("spin", Gyro("tip")), NamedSensor("a", rb.sensors.Accelerations()))
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 5))
    each = rb.threads(lambda s: rb.sense(model, s))
    pairs = zip(states.q, states.v, strict=True)
    one = jnp.stack([rb.sense(model, rb.State(q, v)) for q, v in pairs])
    np.testing.assert_allclose(jax.vmap(each)(states), one, rtol=1e-12)


def test_bad_sensors_and_arguments():
    state = rb.load("two_link").default_state()
    with pytest.raises(rb.UnknownName, match="site or body 'hand'"):
        rb.sense(small(NamedSensor("x", Gyro("hand"))), state)
    with pytest.raises(rb.InputError, match=r"sensor is .* expected a sensor"):
        NamedSensor("x", Gyro)
    with pytest.raises(rb.InputError, match="cutoff is -1"):
        NamedSensor("x", Gyro("tip"), cutoff=-1)
    with pytest.raises(rb.InputError, match="named is 3"):
        rb.sense(small(), state, named=3)
    with pytest.raises(rb.InputError, match="state is array"):
        rb.sense(small(), np.zeros(2))
    with pytest.raises(rb.InputError, match="joint1' is a hinge joint, expected ball"):
        rb.sensors.BallQuaternion("joint1").columns(rb.load("two_link"))


XML = """<mujoco><worldbody><body><joint name="j"/><geom size="0.1" contype="0" conaffinity="0"/>
<site name="s"/><camera name="c"/></body></worldbody><sensor>%s</sensor></mujoco>"""


def test_sensors_that_are_not_read_are_named_by_kind():
    user = '<user name="mine" dim="2"/><jointpos name="angle" joint="j"/>'
    with pytest.warns(UserWarning, match=r"sensors of the kind user \(mine\)"):
        model = rb.load(XML % user)
    assert [s.name for s in model.sensors] == ["angle"]
    assert not any("angle" in entry for entry in model.dropped)
