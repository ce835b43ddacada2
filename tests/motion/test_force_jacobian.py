"""The Jacobian of the forces, a block for each joint, against one tangent for each column."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.drivers import choice
from rbjax.forces.inputs import Inputs
from rbjax.motion import linearise as force_jacobian
from rbjax.motion.linearise import box_plus, generalized_forces
from tests.tolerances import F64_ROUNDING, relative_error

HINGE, SLIDE = (
    f'<joint name="{name}" type="{name}" axis="0 1 {k}" stiffness="3" damping="0.4"/>'
    for k, name in enumerate(("hinge", "slide"))
)
BALL = '<joint name="ball" type="ball" stiffness="2" damping="0.3"/>'
FREE = '<joint name="free" type="free"/>'
SERVO = '<position joint="{}" kp="3" kv="0.1" forcerange="-2 2" ctrlrange="-1 1" gear="2 1 3"/>'
MOTOR = '<motor joint="{}" gear="1 2 3 0.1 0.2 0.3"/>'


def tree(joints: tuple, actuators: tuple) -> rb.Model:
    inside = ""
    for k, joint in enumerate(reversed(joints)):
        site = "" if k else '<site name="s" pos="0 0 1"/>'
        inside = (
            f'<body pos="0.1 0 0.2">{joint}<geom size="0.1" pos="0.1 0 0"/>{site}{inside}</body>'
        )
    driven = "".join(actuators)
    head = '<mujoco><option><flag contact="disable"/></option><worldbody>'
    return rb.load(f"{head}{inside}</worldbody><actuator>{driven}</actuator></mujoco>")


CASES = {
    "hinges, two actuators on one": ((HINGE, SLIDE), tuple(
        x.format(joint) for x in (SERVO, MOTOR) for joint in ("hinge", "slide"))),
    "one joint is not driven": ((HINGE, SLIDE), (SERVO.format("slide"),)),
    "no actuator": ((HINGE,), ()),
    "a free base, a ball and a hinge": ((FREE, BALL, HINGE), tuple(
        x.format(joint) for x, joint in
        ((MOTOR, "free"), (MOTOR, "ball"), (SERVO, "hinge")))),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "dtype"),
    [*((case, jnp.float64) for case in CASES), (next(iter(CASES)), jnp.float32)],
)
def test_against_one_tangent_a_column(case, dtype, monkeypatch):
    model = tree(*CASES[case]).astype(dtype)
    state = model.random_state(jax.random.key(1))
    u = jnp.linspace(-1.3, 1.2, model.nu).astype(dtype)
    M = jax.random.normal(jax.random.key(2), (model.nv, model.nv), dtype)

    def forces(model, dx, du):
        return generalized_forces(model, 0.0, box_plus(model, state, dx), Inputs(u + du))[0]

    def found(model):
        return force_jacobian.times_jacobian(model, lambda *x: forces(model, *x), model.nu, M)

    def dense(model):
        zero = jnp.zeros(2 * model.nv, dtype), jnp.zeros(model.nu, dtype)
        F_x, F_u = jax.jacfwd(lambda *x: forces(model, *x), (0, 1))(*zero)
        return M @ F_x, M @ F_u

    assert not force_jacobian.by_joint(model)  # small models take one tangent a column
    monkeypatch.setattr(force_jacobian, "CPU_UNROLLED_UP_TO", 0)
    assert force_jacobian.by_joint(model)
    tolerance = 50 * float(jnp.finfo(dtype).eps)  # of sums of three products
    for a, b in zip(jax.jit(found)(model), jax.jit(dense)(model), strict=True):
        assert a.dtype == dtype and a.shape == b.shape
        assert relative_error(a, b) < tolerance


@pytest.mark.parametrize("dt", [None, 0.01])
def test_linearise_by_blocks_is_linearise(dt, monkeypatch):
    model = tree(*CASES["hinges, two actuators on one"])
    state, u = model.random_state(jax.random.key(3)), 0.3 * jnp.ones(model.nu)

    def found():
        return jax.jit(lambda model: rb.linearise(model, state, u, dt))(model)

    one = found()
    monkeypatch.setattr(force_jacobian, "CPU_UNROLLED_UP_TO", 0)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(found()), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=100 * F64_ROUNDING * float(abs(a).max()))


def test_forces_that_reach_beyond_their_joint_take_one_tangent_a_column(monkeypatch):
    monkeypatch.setattr(force_jacobian, "CPU_UNROLLED_UP_TO", 0)
    model = tree((HINGE, SLIDE), ())
    assert force_jacobian.by_joint(model)
    ends = rb.forces.Place.on(point=[0.0, 0.0, 1.0]), rb.forces.Place.on(body=0)
    spring = rb.forces.PointSpring.of(*ends, stiffness=3.0)  # it couples the joints
    assert not force_jacobian.by_joint(model.replace(forces=(spring,)))
    at_site = tree((HINGE, SLIDE), ('<motor site="s" gear="1 0 0 0 0 0"/>',))
    assert not force_jacobian.by_joint(at_site)


@pytest.mark.slow
def test_the_program_of_a_chain_of_40_hinges_is_short(monkeypatch):
    """63,713 statements before; the compile time is proportional to them."""
    from rbjax.compiler.jax import primitive

    write, sizes = primitive.write_program, []

    def counted(*args, **kwargs):
        sizes.append((out := write(*args, **kwargs)).statements)
        return out

    monkeypatch.setattr(primitive, "write_program", counted)
    hinges = [HINGE.replace("hinge", f"h{k}", 1) for k in range(40)]
    model = tree(tuple(hinges), tuple(MOTOR.format(f"h{k}") for k in range(40)))
    args = model, model.random_state(jax.random.key(0)), jnp.zeros(40)
    jax.jit(rb.linearise).lower(*args)
    assert 10_000 < sum(sizes) < 50_000


@pytest.mark.parametrize("dt", [None, 0.01])
def test_link_constants_as_a_program_of_their_own(dt, monkeypatch):
    """As for large models: values, and derivatives by the model, forward, reverse and of a batch of
    models."""
    model = tree(*CASES["hinges, two actuators on one"])
    state, u = model.random_state(jax.random.key(3)), 0.3 * jnp.ones(model.nu)

    def total(mass):
        heavy = model.replace(bodies=model.bodies.replace(mass=mass))
        A, B = rb.linearise(heavy, state, u, dt)
        return jnp.sin(A).sum() + jnp.sin(B).sum()

    mass = model.bodies.mass

    def found():
        run = jax.jit(lambda m: (total(m), jax.jacfwd(total)(m), jax.grad(total)(m)))
        return run(mass), jax.jit(jax.vmap(lambda m: total(m)))(jnp.stack([mass, 2 * mass]))

    want = found()
    monkeypatch.setattr(choice, "THREADS_UNROLLED_UP_TO", {4: 0, 8: 0})
    monkeypatch.setattr(choice, "CPU_UNROLLED_UP_TO", 0)
    monkeypatch.setattr(force_jacobian, "CPU_UNROLLED_UP_TO", 0)
    assert choice.on_threads(model, float, pairs=True).driver == "rolled"
    for a, b in zip(jax.tree.leaves(want), jax.tree.leaves(found()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)  # sines of entries up to 1e3
