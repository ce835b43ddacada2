"""Readings of sensors: beside MuJoCo's, and numbers found from each of them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import Columns, Context, Currents, CustomSensor
from rbjax.sysid import (
    Channel,
    Grid,
    Recording,
    Setup,
    Unknown,
    identify,
)
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import make_batch
from rbjax.sysid.simulation.simulation_error import SimulationError
from tests.sysid.sensed import ARM, FLIGHT, T, by_mujoco, first, loaded, swung, thrown

PLACED = ("accelerometer:imu", "gyro:imu", "position:imu", "pose:imu")
GRID = Grid(T)
LINK = {
    "mass": Unknown("bodies.mass", 1, positive=True),
    "com": Unknown("bodies.com", (1, np.array([0, 2])), scale=0.1),
}
TRUTH = [0.6, 0.03, -0.15]
SHAPE = {"inertia": Unknown("bodies.inertia", (0, np.arange(3), np.arange(3)), positive=True)}


def guessed(*sensors):
    """The arm with a link that is too heavy, its centre elsewhere."""
    model, _ = loaded(ARM)
    mass, com = model.bodies.mass.at[1].set(0.8), model.bodies.com.at[1].set([0.0, 0.0, -0.1])
    return Setup.of(model.replace(bodies=model.bodies.replace(mass=mass, com=com))).with_sensors(
        *sensors
    )


def in_flight(sensor):
    """The robot in flight with another inertia."""
    model, _ = loaded(FLIGHT)
    inertia = model.bodies.inertia.at[0].set(jnp.diag(jnp.array([0.03, 0.04, 0.04])))
    setup = Setup.of(model.replace(bodies=model.bodies.replace(inertia=inertia)))
    return setup if sensor == "q" else setup.with_sensors(sensor)


@pytest.mark.parametrize(("xml", "body"), [(ARM, "lower"), (FLIGHT, "base")])
def test_readings_are_those_of_mujoco(xml, body):
    model, m = loaded(xml)
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    names = [*PLACED, f"pose:{body}", *(["tau"] if m.nu else [])]
    setup = Setup.of(model).with_sensors(*names)
    state = model.random_state(jax.random.key(0))
    state = state.replace(v=jnp.asarray(rng.normal(size=model.nv)))
    ctrl = jnp.asarray(rng.normal(size=model.nu))
    at = lambda s, u: Context.of(model, 0.0, s, u)  # noqa: E731
    read = jax.jit(lambda s, u: {n: setup.sensor(n)(at(s, u)) for n in names})
    found = read(state, ctrl)
    d.qpos[:], d.qvel[:], d.ctrl[:] = state.q, state.v, ctrl
    mujoco.mj_forward(m, d)
    for name in names:
        off = setup.columns(name).minus(found[name], jnp.asarray(by_mujoco(m, d, name)))
        np.testing.assert_allclose(off, 0.0, atol=1e-10, err_msg=name)


def test_columns_of_attitudes():
    """x (+) (y (-) x) = y, whatever the signs of quaternions; zeros were not measured."""
    columns, rng = Columns(9, (1,)), np.random.default_rng(1)
    x, y = rng.normal(size=(2, 9))
    x[1:5], y[1:5] = (a / np.linalg.norm(a) for a in (x[1:5], y[1:5]))
    d = columns.minus(jnp.asarray(y), jnp.asarray(x))
    back = columns.plus(jnp.asarray(x), d)
    np.testing.assert_allclose(columns.minus(back, jnp.asarray(y)), 0.0, atol=1e-14)
    flipped = y.copy()
    flipped[1:5] *= -1
    np.testing.assert_allclose(columns.minus(jnp.asarray(flipped), jnp.asarray(x)), d, atol=1e-14)
    np.testing.assert_allclose(columns.aligned(flipped[None], y[None])[0], y)
    slope = jax.jacfwd(columns.minus)(jnp.asarray(y), jnp.zeros(9))
    assert np.isfinite(slope).all()
    w = columns.weights(jnp.array([1.0, 2, 3, 0, 4, 5, 6, 7, 8]))
    np.testing.assert_array_equal(w, [1, 0, 0, 0, 5, 6, 7, 8])
    # a rotation by a small noise of 1e-3 rad about each axis
    phi = 1e-3 * rng.normal(size=(4000, 3))
    seen = jax.vmap(lambda f: Columns(4, (0,)).plus(jnp.asarray(x[1:5]), f))(jnp.asarray(phi))
    off = Columns(4, (0,)).residual(np.tile(x[1:5], (4000, 1)), np.asarray(seen))
    sigma = Columns(4, (0,)).noise(np.sqrt((off**2).mean(0)))
    np.testing.assert_allclose(sigma, 1e-3, rtol=0.03)


def test_units_are_those_of_what_is_read():
    arm, cart = Setup.of(loaded(ARM)[0]).with_sensors(*PLACED, "tau", "a"), rb.load("cart_pole")
    assert [arm.unit(s) for s in ("q", "v", "a", "tau", *PLACED)] == [
        "rad", "rad/s", "rad/s^2", "N m", "m/s^2", "rad/s", "m", "m or rad",
    ]  # fmt: skip
    assert Setup.of(cart).unit("q") == "rad or m"


def test_bad_sensors_are_named():
    setup = Setup.of(loaded(ARM)[0])
    with pytest.raises(rb.UnknownName, match="site or body 'hand'"):
        setup.with_sensors("gyro:hand")
    with pytest.raises(rb.UnknownName, match="body or site 'hand'"):
        setup.with_sensors("pose:hand")
    with pytest.raises(rb.UnknownName, match="unknown sensor kind 'other:x'"):
        setup.with_sensors("other:x")
    two = setup.with_sensors({"other:x": CustomSensor(lambda context: context.state.q, 2)})
    t = np.arange(5) * T
    run = Recording("x", first(t, np.zeros(2), np.zeros(2)) | {"other:x": Channel(t, t)})
    with pytest.raises(rb.InputError, match="other:x of recording x has 1 columns, expected 2"):
        identify(two, run, LINK)


def test_a_function_of_a_user_and_a_reading_that_nothing_moves():
    model, t = rb.load("pendulum"), np.arange(61) * 0.01
    heavy = model.replace(bodies=model.bodies.replace(mass=jnp.array([1.4])))
    start = rb.State(jnp.array([0.5]), jnp.array([0.2]))
    path = rb.rollout(heavy, start, None, 0.01, steps=60, integrator="rk4", kernel=False)
    height = -np.cos(np.asarray(path.q) + 0.4) + 0.2
    channels = {"other:height": Channel(t[::2], height[::2]), "other:clock": Channel(t, t)}
    run = Recording("seen", first(t, start.q, start.v) | channels)
    setup = Setup.of(model.replace(joints=model.joints.replace(damping=jnp.array([0.1]))))
    setup = setup.with_sensors({
        "other:height": CustomSensor(lambda context: -jnp.cos(context.state.q + 0.4), 1, "m"),
        "other:clock": CustomSensor(lambda context: context.t[None], 1, "s"),
    })  # fmt: skip
    sought = {"mass": Unknown("bodies.mass", 0, positive=True),
              "damping": Unknown("joints.damping", 0, positive=True),
              "bias": Unknown("sensors.other:height.bias")}  # fmt: skip
    found = identify(setup, run, sought, grid=Grid(0.01))
    damping = float(model.joints.damping[0])
    np.testing.assert_allclose([*found.values.values()], [1.4, damping, 0.2], atol=1e-8)
    assert (
        found.success
        and found.insensitive_sensors == ("other:clock",)
        and found.unused_channels == ()
    )
    assert found.judged_sensor == "other:height" and found.setup.unit(found.judged_sensor) == "m"


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("accelerometer:imu",)])
def test_sensors_of_one_recording_at_several_rates(more):
    """A gyro at 200 Hz with a bias, a marker at 100 Hz, an accelerometer at 40 Hz; what nothing
    moves is named."""
    sensors = ("gyro:imu", "position:imu", *more)
    run = swung(sensors, (1, 2, 5), 80)
    gyro = run["gyro:imu"]
    biased = Channel(gyro.t, gyro.values + np.array([0.02, -0.01, 0.03]))
    clock = Channel(gyro.t[::7], gyro.t[::7])
    run = Recording("all", run.channels | {"gyro:imu": biased, "other:clock": clock})
    time = CustomSensor(lambda context: jnp.array([context.t]), 1, "s")
    setup = guessed(*sensors, {"other:clock": time})
    found = identify(setup, run, LINK | {"bias": Unknown("sensors.gyro:imu.bias")}, grid=GRID)
    np.testing.assert_allclose([*found.values.values()], [*TRUTH, 0.02, -0.01, 0.03], atol=1e-8)
    assert (
        found.success
        and found.insensitive_sensors == ("other:clock",)
        and found.unused_channels == ()
    )
    trace = found.traces["all"]
    lengths = [len(trace[s].t) for s in (*sensors, "other:clock")]
    assert lengths == [78, 39, *[16 for _ in more], 12]  # until the last tick of the slowest
    assert found.judged_sensor == ("accelerometer:imu" if more else "gyro:imu")


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [*PLACED, "pose:lower", "tau"])
def test_a_link_from_one_sensor_alone(sensor):
    """Its mass and its centre, from what MuJoCo's sensor showed."""
    found = identify(guessed(sensor), swung((sensor,)), LINK, grid=GRID)
    assert found.success and found.identifiable.rank == 3
    np.testing.assert_allclose([*found.values.values()], TRUTH, atol=1e-8)


@pytest.mark.slow
def test_a_link_and_the_constants_of_its_motors_from_currents():
    run, constant = swung(("tau",)), np.array([0.1, 0.25])
    current = Channel(run["tau"].t, run["tau"].values / constant, unit="A")
    run = Recording("currents", {s: run[s] for s in ("q", "v", "ctrl")} | {"current": current})
    setup = guessed({"current": Currents(jnp.array([0.2, 0.2]))})
    motors = {"constant": Unknown("readings.current.constant", positive=True)}
    found = identify(setup, run, LINK | motors, grid=GRID)
    np.testing.assert_allclose([*found.values.values()], [*TRUTH, *constant], atol=1e-8)


@pytest.mark.slow
def test_the_scale_of_an_accelerometer():
    sensor = "accelerometer:imu"
    run = swung((sensor,))
    scaled = Channel(run[sensor].t, run[sensor].values * 1.02 + [0.1, 0.2, -0.3])
    run = Recording("scaled", run.channels | {sensor: scaled})
    more = {k: Unknown(f"sensors.{sensor}.{k}") for k in ("scale", "bias")}
    found = identify(guessed(sensor), run, LINK | more, grid=GRID)
    want = [*TRUTH, 1.02, 1.02, 1.02, 0.1, 0.2, -0.3]
    np.testing.assert_allclose([*found.values.values()], want, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [*PLACED, "pose:base", "q"])
def test_ratios_of_inertia_from_one_sensor_in_flight(sensor):
    """Without forces no motion shows their size."""
    found = identify(in_flight(sensor), thrown(sensor), SHAPE, grid=GRID)
    x = np.array([*found.values.values()])
    assert found.success and found.identifiable.rank == 2
    np.testing.assert_allclose(x / x[0], [1.0, 2.5, 1.5], rtol=1e-8)


@pytest.mark.slow
def test_a_start_that_is_not_known_is_sought_on_the_manifold():
    """An attitude off by 0.2 rad and a spin off by 0.3 rad/s, both with much noise."""
    run = thrown("pose:base")
    q, v = (np.array(run[s].values[0]) for s in "qv")
    q[3:] = [np.cos(0.1), 0.0, np.sin(0.1), 0.0]
    off = first(run["pose:base"].t, q, v + 0.3, noise=1e7)
    found = identify(
        in_flight("pose:base"),
        Recording("x", run.channels | off),
        SHAPE,
        grid=GRID,
        estimate_initial_state=True,
    )
    x = np.array([*found.values.values()])
    np.testing.assert_allclose(x / x[0], [1.0, 2.5, 1.5], rtol=1e-8)


@pytest.mark.slow
def test_noise_of_attitudes_is_that_of_the_rotation():
    """The fit estimates it, and says the unit where it judges."""
    runs, rng = [], np.random.default_rng(3)
    for k in range(2):
        run = thrown("pose:base")
        move = jax.vmap(Columns(7, (3,)).plus)
        size = np.array([2e-3] * 3 + [5e-3] * 3)
        noise = size * rng.normal(size=(121, 6))
        seen = move(jnp.asarray(run["pose:base"].values), jnp.asarray(noise))
        runs.append(Recording(f"{k}", run.channels | {"pose:base": Channel(run["q"].t, seen)}))
    found = identify(in_flight("pose:base"), runs[:1], SHAPE, grid=GRID)
    np.testing.assert_allclose(1 / found.error.runs.weights["pose:base"][0, 0, 3:], 5e-3, rtol=0.1)
    verdict = found.validate(runs[1:])
    assert (
        found.judged_sensor == "pose:base"
        and "m or rad RMS" in verdict.summary()
        and verdict.success
    )


@pytest.mark.slow
def test_slopes_of_all_sensors():
    """Beside central differences of order four: truncation and rounding below 1e-7."""
    sensors = (*PLACED, "pose:lower", "tau")
    setup, run = guessed(*sensors), swung(sensors, N=40)
    sought = Unknowns.of("test", LINK, setup)
    of = SimulationError(
        setup, sought, make_batch(setup, [run], GRID), GRID, estimate_initial_state=True
    )
    x = np.concatenate([np.asarray(sought.read(setup)), 0.1 * np.arange(4)])
    J = of.slopes(x)[1][0]
    for k, e in enumerate(1e-4 * np.eye(len(x))):
        near, far = ((of.residuals(x + d) - of.residuals(x - d))[0] / 2e-4 for d in (e, 2 * e))
        want = (4 * near - far / 2) / 3
        np.testing.assert_allclose(J[:, k], want, atol=1e-6 * max(1.0, np.abs(want).max()))
