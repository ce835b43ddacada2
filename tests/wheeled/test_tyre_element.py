"""A tyre on a plane within a model: power, rest, braking, pushing, and the limit of no slip."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.forces import Context
from rbjax.wheeled import Coulomb, Fiala, LinearTyre, Relaxing, RollingResistance, TyreOnGround
from tests.constraints.rows import tree
from tests.constraints.test_rolling import ORACLE, disc, on_the_plane
from tests.tolerances import GRADIENT
from tests.wheeled.laws import LAWS

R, G = 0.3, 9.81
PLANE = rc.Place.on(body="leg", point=[0.1, -0.2, 0.05], axis=[1.0, 0.4, 2.0])
WHEEL = rc.Place.on(body="hand", point=[0.05, 0.1, -0.1], axis=[0.3, 1.0, 0.2])
GROUND, HUB = rc.Place.on(), rc.Place.on(body="wheel", axis=[0.0, 1.0, 0.0])


def on_a_carriage(joints: str, mass=20.0, spin=0.4, slope=0.0) -> rb.Model:
    """A wheel of 20 kg with the axle along y, and these ways to move."""
    pull = f"{G * np.sin(slope)} 0 {-G * np.cos(slope)}"
    slides = "".join(f'<joint type="slide" axis="{a}"/>' for a in joints.split(",") if " " in a)
    hinge = '<joint axis="0 1 0"/>' if "spin" in joints else ""
    return rb.load(f"""<mujoco><option gravity="{pull}"/><worldbody><body name="wheel">
      {slides}{hinge}<inertial pos="0 0 0" mass="{mass}" diaginertia="1 {spin} 1"/>
      </body></worldbody></mujoco>""")


ALONG, ACROSS, UP = "1 0 0", "0 1 0", "0 0 1"


def generalized_power(model, state):
    return rb.applied_forces(model, state) @ state.v


@pytest.mark.parametrize(("law", "damping"), [("tmeasy, two", 30.0), ("relaxing", 0.0)])
def test_power(law, damping):
    """Of a plane that moves with one body and a wheel that leans on another: what all forces on all
    bodies do is what the spring gives back, what the damper and the contact lose, no more."""
    tyre = Relaxing(LAWS["fiala, two"], [0.2, 0.4], 0.01) if law == "relaxing" else LAWS[law]
    drags = RollingResistance(0.1, 0.5)
    wheel = TyreOnGround(PLANE, WHEEL, tyre, 0.9, 1e3, damping, 0.01, drags)
    model = tree().with_forces(wheel)

    @jax.jit
    @jax.vmap
    def powers(key):
        state = model.random_state(key)
        if wheel.size:
            state = state.replace(x=0.01 * jax.random.normal(key, (2,)))
        context = Context.of(model, 0.0, state, None)
        at = wheel.contact(context)

        def stored(q):
            context = Context.of(model, 0.0, state.replace(q=q), None)
            bare = wheel.replace(tyre=LAWS["linear"]) if law == "relaxing" else wheel
            return jnp.asarray(bare.energy(context))

        path = lambda s: stored(rb.integrate(model, state.q, s * state.v))  # noqa: E731
        _, storing = jax.jvp(path, (0.0,), (1.0,))
        slides = at.load * (at.traction[0] * at.sliding[0] + at.traction[1] * at.sliding[1])
        drag = wheel.resistance.torque(at.load, at.lever, at.lever * at.spin) * at.spin
        return generalized_power(model, state), storing, slides, drag, at.load, at.depth

    every = powers(jax.random.split(jax.random.key(0), 200))
    total, storing, slides, drag, load, depth = map(np.asarray, every)
    touches = (depth > 0) & (depth < 1.0)
    assert 20 < touches.sum() < 200
    assert np.all(load[depth <= 0] == 0) and np.all(total[depth <= 0] == 0)
    assert np.all(load >= 0) and np.all(drag <= 0)
    lost = (total + storing - slides - drag)[touches]
    scale = np.max(np.abs([total, storing, slides]), 0)[touches]
    if damping:
        assert np.all(lost <= 1e-9 * scale) and np.any(lost < -1e-3 * scale)
    else:
        assert np.max(np.abs(lost / scale)) < 1e-9
    if law != "relaxing":
        assert np.all(slides[touches] < 0)


def at_rest(model, wheel, **v):
    """Standing on its tyre; velocities by the joint's place."""
    depth = G * float(model.bodies.mass[0]) / float(wheel.stiffness) + float(wheel.onset) / 2
    state = model.default_state()
    up = next(i for i, a in enumerate(np.asarray(model.joints.axis)) if a[2] == 1)
    speeds = jnp.array([v.get(f"v{i}", 0.0) for i in range(model.nv)])
    x = jnp.zeros(wheel.size) if wheel.size else None
    return state.replace(q=state.q.at[up].set(R - depth), v=speeds, x=x)


def test_a_dropped_wheel_settles():
    wheel = TyreOnGround(GROUND, HUB, Coulomb(0.8), R, 2e4, 400.0, 1e-3)
    model = on_a_carriage(UP).with_forces(wheel)
    start = model.default_state().replace(q=jnp.array([0.5]))
    found = jax.jit(
        lambda start: rb.rollout(model, start, steps=2000, dt=1e-3, integrator="rk4").q[:, 0]
    )(start)
    want = at_rest(model, wheel).q[0]
    np.testing.assert_allclose(found[-1], want, atol=1e-9)
    assert found.min() < want - 0.02  # it fell in first
    np.testing.assert_allclose(found[150], 0.5 - G / 2 * 0.15**2, rtol=0.02)  # and was free before


def test_braking():
    """A locked wheel: mu g, until it stands after v^2 / (2 mu g)."""
    wheel = TyreOnGround(GROUND, HUB, Coulomb(0.7, 0.05, smooth_speed=0.1), R, 2e4)
    model = on_a_carriage(f"{ALONG},{UP}").with_forces(wheel)
    start = at_rest(model, wheel, v0=8.0)
    a = rb.forward_dynamics(model, start.q, start.v, rb.applied_forces(model, start))
    np.testing.assert_allclose(a, [-0.7 * G, 0.0], rtol=1e-6, atol=1e-12)

    end = jax.jit(lambda s: rb.rollout(model, s, steps=1500, dt=1e-3, integrator="rk4"))(start)
    np.testing.assert_allclose(end.q[-1, 0], 8.0**2 / (2 * 0.7 * G), rtol=1e-4)
    assert abs(end.v[-1, 0]) < 1e-8


def test_a_push_from_the_side():
    """A rolling wheel drifts until c s = F / N; the way there is exponential."""
    wheel = TyreOnGround(GROUND, HUB, LinearTyre([50.0, 9.0], smooth_speed=0.05), R, 2e4)
    model = on_a_carriage(f"{ALONG},{ACROSS},{UP},spin").with_forces(wheel)
    state = at_rest(model, wheel, v0=4.0)
    lever = state.q[2]
    state = state.replace(v=state.v.at[3].set(4.0 / lever))
    tau = jnp.tile(jnp.array([0.0, 30.0, 0.0, 0.0]), (200, 1))
    run = jax.jit(lambda s: rb.rollout(model, s, tau=tau, steps=200, dt=1e-3, integrator="rk4"))
    found = run(state)
    reference = np.hypot(4.0, 0.05)
    ends = reference * 30.0 / (20 * G * 9.0)
    t = np.arange(201) * 1e-3
    want = ends * (1 - np.exp(-G * 9.0 / reference * t))
    np.testing.assert_allclose(found.v[:, 1], want, rtol=1e-6)
    np.testing.assert_allclose(found.v[-1, [0, 3]], [4.0, 4.0 / lever], rtol=1e-12)


def test_coasting():
    """Rolling resistance slows what turns and what moves: c N = (m + I / D^2) a."""
    drag = RollingResistance(0.02, 0.01)
    wheel = TyreOnGround(GROUND, HUB, LinearTyre(50.0), R, 2e4, resistance=drag)
    model = on_a_carriage(f"{ALONG},{UP},spin").with_forces(wheel)
    state = at_rest(model, wheel, v0=4.0)
    lever = state.q[1]
    state = state.replace(v=state.v.at[2].set(4.0 / lever))
    run = jax.jit(lambda s: rb.rollout(model, s, steps=400, dt=5e-4, integrator="rk4").v[:, 0])
    v = run(state)
    want = -0.02 * 20 * G / (20 + 0.4 / lever**2)
    np.testing.assert_allclose((v[-1] - v[200]) / 0.1, want, rtol=0.02)


def test_a_relaxing_tyre_holds_on_a_slope():
    """With the wheel locked, by `rollout` and by `simulate`; the tyre's state is the State's x."""
    tyre = Relaxing(Fiala(12.0, 0.8, smooth_speed=1e-5), 0.3, 0.02)
    wheel = TyreOnGround(GROUND, HUB, tyre, R, 2e4, 600.0)
    model = on_a_carriage(f"{ALONG},{UP}", slope=0.2).with_forces(wheel)
    start = at_rest(model, wheel)
    rolled = jax.jit(lambda s: rb.rollout(model, s, steps=4000, dt=1e-3, integrator="rk4"))(start)
    mu = np.tan(0.2)
    np.testing.assert_allclose(-rolled.x[-1], [mu * 0.3 / 12, 0.0], rtol=1e-4)
    assert np.abs(rolled.v[-1]).max() < 1e-6 and 0 < rolled.q[-1, 0] < 0.02
    simulated = rb.simulate(model, start, jnp.array([0.0, 0.2]))
    np.testing.assert_allclose(simulated.x[-1], rolled.x[200], atol=1e-6)
    np.testing.assert_allclose(simulated.q[-1], rolled.q[200], atol=1e-6)


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(n, marks=pytest.mark.slow)  # test_tyre_laws.py, test_relaxation.py are quick
        for n in ("relaxing", "pacejka, two", "tmeasy, two")
    ],
)
def test_gradients_of_a_motion(law):
    """By every number of the tyre, against central differences."""
    tyre = Relaxing(LAWS["fiala, two"], [0.2, 0.4], 0.01) if law == "relaxing" else LAWS[law]
    wheel = TyreOnGround(GROUND, HUB, tyre, R, 2e3, 40.0, 0.01, RollingResistance(0.02, 0.1))
    bare = on_a_carriage(f"{ALONG},{ACROSS},{UP},spin")
    state = at_rest(bare, wheel, v0=2.0, v1=0.3, v2=0.1, v3=7.0)
    leaves, structure = jax.tree.flatten(wheel)
    sizes = np.cumsum([np.size(x) for x in leaves])[:-1]

    def cost(row):
        parts = [p.reshape(np.shape(x)) for p, x in zip(jnp.split(row, sizes), leaves, strict=True)]
        model = bare.with_forces(jax.tree.unflatten(structure, parts))
        end = rb.rollout(model, state, steps=60, dt=2e-3, integrator="rk4")
        return end.q[-1].sum() + (end.v[-1] ** 2).sum()

    row = jnp.concatenate([jnp.ravel(x) for x in leaves])
    gradient = jax.jit(jax.grad(cost))(row)
    assert np.isfinite(gradient).all()
    steps = 6e-6 * jnp.diag(jnp.maximum(jnp.abs(row), 1e-2))
    ends = jax.jit(jax.vmap(lambda d: (cost(row + d) - cost(row - d)) / (2 * jnp.abs(d).sum())))
    scale = max(1.0, np.abs(gradient).max())
    assert np.abs(ends(steps) - gradient).max() / scale < 10 * GRADIENT


def test_the_roll_speed_is_that_of_the_contact_on_the_ground():
    """A disc that leans, turns and rolls without slip: its contact runs as fast as the rim does."""
    p, oracle = ORACLE["rolling_disc"]["params"], ORACLE["rolling_disc"]["generic"]
    turn = np.array(oracle["R0"]).reshape(3, 3)
    start = on_the_plane(turn, np.array(oracle["omega0"]), oracle["com0"])
    free, hub = disc().replace(constraints=()), rc.Place.on(body="disc")
    wheel = TyreOnGround(GROUND, hub, LinearTyre(1.0), jnp.asarray(p["r"]), 1e3)

    def at(s):
        q = rb.integrate(free, start.q, s * start.v)
        found = wheel.contact(Context.of(free, 0.0, start.replace(q=q), None))
        return found.p.array, (found.x.array, jnp.stack([*found.sliding, found.roll_speed]))

    (_, (x, speeds)), (dp, _) = jax.jit(lambda: jax.jvp(at, (0.0,), (1.0,)))()
    np.testing.assert_allclose(speeds[:2], 0, atol=1e-6)  # the oracle's numbers of the start
    np.testing.assert_allclose(dp @ x, speeds[2], rtol=1e-6)
    assert abs(turn[2, 2]) > 0.1  # it does lean


@pytest.mark.slow
def test_the_limit_is_rolling_without_slip():
    """The disc of the oracle that leans and turns, on ever stiffer tyres: both the depth and the
    slip fall as 1 / stiffness."""
    p, oracle = ORACLE["rolling_disc"]["params"], ORACLE["rolling_disc"]["generic"]
    free = disc().replace(constraints=())
    start = on_the_plane(
        np.array(oracle["R0"]).reshape(3, 3), np.array(oracle["omega0"]), oracle["com0"]
    )
    hub = rc.Place.on(body="disc")
    want = rb.rollout(disc(), start, steps=400, dt=5e-4, integrator="rk4")

    @jax.jit
    @jax.vmap
    def off(k):
        # critically damped, so that what the start lacks in depth dies out
        wheel = TyreOnGround(
            GROUND, hub, LinearTyre(k / 1e3, smooth_speed=0.1), jnp.asarray(p["r"]), k,
            2 * jnp.sqrt(k * p["m"]), 1e-5,
        )  # fmt: skip
        model = free.with_forces(wheel)
        depth = p["m"] * G / k
        lower = start.replace(q=start.q.at[2].add(-depth))
        found = rb.rollout(model, lower, steps=4000, dt=5e-5, save_every=10, integrator="rk4")
        return jnp.abs(found.q[-1] - want.q[-1]).max()

    found = np.asarray(off(jnp.array([2e4, 8e4])))
    assert found[1] < 2e-3 and 2.5 < found[0] / found[1] < 6.0


def test_in_single_precision_and_as_a_thread():
    tyre = Relaxing(LAWS["tmeasy, two"], 0.3)
    wheel = TyreOnGround(GROUND, HUB, tyre, R, 2e4, 400.0, resistance=RollingResistance(0.02))
    model = on_a_carriage(f"{ALONG},{UP},spin").with_forces(wheel)
    state = at_rest(model, wheel, v0=2.0, v2=7.0).replace(x=jnp.full(2, 0.01))
    half = model.astype(jnp.float32)
    light = jax.tree.map(lambda x: x.astype(jnp.float32), state)
    found = jax.jit(rb.applied_forces)(half, light)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(
        found, jax.jit(rb.applied_forces)(model, state), rtol=1e-3, atol=0.05
    )
    explained = rb.compiler.explain(lambda s: rb.applied_forces(half, s), light)
    assert explained.operations < 400


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"tyre": 0.8}, "TyreOnGround: tyre is 0.8, expected a tyre law or Relaxing"),
        ({"resistance": 0.01}, "resistance is 0.01, expected RollingResistance"),
        ({"radius": 0.0}, r"radius=...\): got 0.0, expected numbers above 0.0"),
        ({"stiffness": [1.0, 2.0]}, r"stiffness=...\): got the shape \(2,\), expected a number"),
        ({"damping": -1.0}, r"damping=...\): got -1.0, expected numbers of at least 0.0"),
        ({"a": "floor"}, "a is 'floor', expected a Place"),
    ],
)
def test_bad_fields(fields, said):
    good = {"a": GROUND, "b": HUB, "tyre": Coulomb(0.8), "radius": R, "stiffness": 1e4}
    with pytest.raises(rb.InputError, match=said):
        TyreOnGround(**(good | fields))
