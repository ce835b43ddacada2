"""A model's leaves are numbers: differentiated, vmapped over and changed without compiling."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.robots import robot
from tests.tolerances import F32_MEDIAN, F64_TRANSFORM, GRADIENT, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit
PUBLIC = "mass com inertia position orientation".split()  # noqa: SIM905
JOINT = "placement axis armature reference".split()  # noqa: SIM905
APPLIED = "damping stiffness springref".split()  # noqa: SIM905


def generic() -> rb.Model:
    return robot("small", "rolled").model


def aligned() -> rb.Model:
    """The same tree with every number that may be zero or one so: com = (0, 0, l), axes x, y, z."""
    model = generic()
    up = jnp.zeros((4, 3)).at[:, 2].set(0.3)
    return model.replace(
        gravity=jnp.array([0.0, 0.0, -9.81]),
        bodies=model.bodies.replace(
            com=up,
            inertia=jnp.stack([jnp.diag(jnp.array([0.02, 0.03, 0.025]))] * 4),
            position=2 * up,
            orientation=jnp.zeros((4, 4)).at[:, 0].set(1.0),
        ),
        joints=model.joints.replace(
            axis=jnp.eye(3)[::-1],
            placement=jnp.zeros((3, 3)),
            armature=jnp.zeros(5),
            damping=jnp.zeros(5),
            stiffness=jnp.zeros(3),
            reference=jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        ),
    )


def motion(model: rb.Model, q, v, weight):
    """A scalar of the robot's acceleration under its own springs, dampers and servos."""
    tau = rb.applied_forces(model, rb.State(q, v), 0.1 * jnp.ones(model.nu))
    return weight @ rb.forward_dynamics(model, q, v, tau)


@jax.jit
def slopes(model, direction, q, v, weight):
    """Reverse mode, and a central difference along a direction in the space of models."""

    def along(t):
        moved = jax.tree.map(lambda x, d: x + t * d, model, direction)
        return motion(moved, q, v, weight)

    gradient = jax.grad(motion, allow_int=True)(model, q, v, weight)
    return gradient, (along(STEP) - along(-STEP)) / (2 * STEP)


ENTRIES = [("bodies", n) for n in PUBLIC] + [("joints", n) for n in (*JOINT, *APPLIED)]
ENTRIES += [("actuators", n) for n in ("gear", "gain", "bias")] + [("", "gravity")]


@pytest.mark.slow
@pytest.mark.parametrize("make", [aligned, pytest.param(generic, marks=pytest.mark.slow)])
def test_every_leaf_has_the_right_derivative(make) -> None:
    model = make()
    q, v = (x[0] for x in robot("small").states(1))
    rng = np.random.default_rng(0)
    weight = rng.normal(size=5)
    still = jax.tree.map(jnp.zeros_like, model)
    for room, name in ENTRIES:
        holder = getattr(model, room) if room else model
        for _ in range(2):
            d = rng.normal(size=getattr(holder, name).shape)
            if name == "inertia":
                d = (d + d.swapaxes(1, 2)) / 100  # stays symmetric, and positive
            if room:
                direction = still.replace(**{room: getattr(still, room).replace(**{name: d})})
            else:
                direction = still.replace(**{name: d})
            gradient, want = slopes(model, direction, q, v, weight)
            part = getattr(getattr(gradient, room) if room else gradient, name)
            assert relative_error((part * d).sum(), want, floor=1.0) <= GRADIENT, (room, name)
            assert np.isfinite(part).all()
    assert slopes._cache_size() == 1  # both models and all directions are one program


def test_a_vmap_over_models_is_a_loop() -> None:
    model = generic()
    q, v = (x[0] for x in robot("small").states(1))
    w = np.arange(1.0, 6.0)
    scales = np.array([0.5, 1.0, 2.0, 3.0])

    def scaled(s):
        bodies = model.bodies.replace(mass=model.bodies.mass * s, com=model.bodies.com * s)
        return model.replace(bodies=bodies, gravity=model.gravity / s)

    fleet = jax.vmap(scaled)(scales)
    assert fleet.bodies.mass.shape == (4, 4)
    one = jax.jit(motion)
    together = jax.jit(jax.vmap(motion, (0, None, None, None)))(fleet, q, v, w)
    alone = [one(scaled(s), q, v, w) for s in scales]
    assert relative_error(together, alone) <= F64_TRANSFORM
    assert one._cache_size() == 1


def test_no_number_recompiles() -> None:
    """A program is compiled for a topology and shapes, not for the numbers of one robot."""
    traces = 0

    @jax.jit
    def energy(model, q):
        nonlocal traces
        traces += 1
        return rb.potential_energy(model, q)

    q = robot("small").states(1)[0][0]
    for model in (generic(), aligned(), generic().replace(gravity=jnp.array([1.0, 2.0, 3.0]))):
        assert np.isclose(energy(model, q), rb.potential_energy(model, q), rtol=1e-12)
    assert traces == 1


def test_closed_over_is_the_same_number_with_less_arithmetic() -> None:
    model = aligned()
    q, v = (x[0] for x in robot("small").states(1))
    w = np.arange(1.0, 6.0)
    closed = jax.jit(lambda q, v: motion(model, q, v, w))(q, v)
    assert relative_error(closed, jax.jit(motion)(model, q, v, w)) <= F64_TRANSFORM


FIXED = {  # what is computed, and the driver
    ("acceleration", "unrolled"): lambda m, q, v: rb.forward_dynamics(m, q, v, jnp.ones(m.nv)),
    ("matrix", "rolled"): lambda m, q, v: rb.mass_matrix(m, q),
    ("height", "unrolled"): lambda m, q, v: rb.potential_energy(m, q),
    ("momentum", "rolled"): lambda m, q, v: rb.centroidal_momentum(m, q, v),
    ("parameters", "unrolled"): lambda m, q, v: rb.dynamics.inertial_parameters(m),
}


@pytest.mark.parametrize("case", FIXED, ids="-".join)
def test_what_is_fixed_is_ignored_however_the_model_comes(case: tuple[str, str]) -> None:
    """As an argument, closed over, or half of it: the entries fixed at zero (or one) stay so, and
    the others are what the leaf says."""
    driver, f = case[1], FIXED[case]
    given, straight = generic().replace(driver=driver), aligned().replace(driver=driver)
    numbers = {"bodies": given.bodies, "joints": given.joints, "gravity": given.gravity}
    model = straight.fix_zeros().replace(**numbers)

    def by_hand(path, old, new):
        units = jax.tree_util.keystr(path) in (".bodies.orientation", ".joints.axis")
        return jnp.where((old == 0) | (units & (jnp.abs(old) == 1)), old, new)

    want = jax.tree_util.tree_map_with_path(by_hand, straight, straight.replace(**numbers))
    q, v = (x[0] for x in robot("small").states(1))
    want = jax.jit(f)(want, q, v)
    found = {
        "argument": jax.jit(f)(model, q, v),
        "closed over": jax.jit(lambda q, v: f(model, q, v))(q, v),
        "half": jax.jit(lambda b, q, v: f(model.replace(bodies=b), q, v))(model.bodies, q, v),
    }
    for how, got in found.items():
        assert relative_error(got, want) <= F64_TRANSFORM, how


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
@pytest.mark.parametrize("fixed", [False, True], ids=["plain", "fixed"])
@pytest.mark.parametrize("state", [jnp.float64, jnp.float32])
def test_the_state_says_the_dtype(driver: str, fixed: bool, state) -> None:
    """A model in the other dtype gives the same numbers to f32 rounding, in the state's dtype, and
    nothing of what it computes for a state in f32 is in f64."""
    double = rb.load("double_pendulum").replace(driver=driver)
    other = jnp.float32 if state == jnp.float64 else jnp.float64
    model = jax.tree.map(lambda x: x.astype(other), double)
    model = model.fix_zeros() if fixed else model
    q, v, tau = (jnp.array(x, state) for x in ([0.3, -0.7], [0.2, 1.1], [0.5, -0.4]))
    want = rb.forward_dynamics(double, *(x.astype(jnp.float64) for x in (q, v, tau)))
    found = [
        jax.jit(rb.forward_dynamics)(model, q, v, tau),
        jax.jit(lambda q: rb.forward_dynamics(model, q, v, tau))(q),
        rb.rollout(model, rb.State(q, v), steps=1, dt=1e-3).v[-1],
    ]
    assert all(x.dtype == state for x in found)
    assert relative_error(found[0], want) <= F32_MEDIAN
    assert relative_error(found[1], want) <= F32_MEDIAN
    if state == jnp.float32 and fixed:
        program = str(jax.make_jaxpr(rb.forward_dynamics)(model, q, v, tau))
        assert " sin" in program and not re.search(r"f64\[[\d,]*\] = (sin|cos|div)", program)
