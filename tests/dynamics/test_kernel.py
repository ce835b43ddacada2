"""The GPU kernels in Pallas's interpreter, against the recursions under XLA; and that Triton takes
them, which lowering for CUDA shows without a GPU."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

import rbjax as rb
from rbjax.dynamics import kernel, kernel_gradient
from rbjax.dynamics.forward import acceleration
from rbjax.dynamics.kernel_rollout import march
from rbjax.errors import InputError
from rbjax.forces.applied import applied_lanes
from rbjax.integrators import TABLEAUS

WALKER = """
<mujoco><worldbody><body><freejoint/>
  <inertial pos="0.01 0 0.02" mass="5" diaginertia="0.1 0.2 0.15"/>
  <body name="a" pos="0 0 0.3"><joint name="a" axis="0 0 1" stiffness="3" armature="0.02"/>
    <inertial pos="0 0 0.1" mass="2" diaginertia="0.03 0.03 0.02"/>
    <body name="b" pos="0 0.1 0.2"><joint name="b" axis="1 0 0" damping="0.1"/>
      <inertial pos="0 0.1 0" mass="1" diaginertia="0.01 0.012 0.009"/></body>
    <body name="c" pos="0 -0.1 0.2"><joint name="c" axis="0 1 1"/>
      <inertial pos="0 -0.1 0" mass="1" diaginertia="0.01 0.012 0.009"/></body></body>
  <body name="d" pos="0 0.1 -0.2"><joint name="d" axis="0 1 0"/>
    <inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.012 0.009"/></body>
</body></worldbody>
<actuator><motor joint="b" ctrllimited="true" ctrlrange="-1 1"/>
  <position joint="d" kp="3"/></actuator>
</mujoco>
"""
# a ball and a slide among the limbs, two motors on a joint, armature of a free joint
MIXED = (
    WALKER.replace('<joint name="c" axis="0 1 1"/>', '<joint name="c" type="ball" armature="0.1"/>')
    .replace('<joint name="d" axis="0 1 0"/>', '<joint name="d" type="slide" damping="0.2"/>')
    .replace("<freejoint/>", '<joint type="free" armature="0.3"/>')
    .replace("<position", '<motor joint="a" gear="2"/><motor joint="a"/><position')
)
# beside a second root, the free joint is no base
TWO_ROOTS = MIXED.replace(
    "</worldbody>", '<body><joint axis="0 1 0"/><geom size="0.1"/></body></worldbody>'
)
WRITTEN = {"walker": WALKER, "mixed": MIXED, "two roots": TWO_ROOTS}
ROLLED = kernel.Plan("rolled", block=4, warps=1, programs=1)
UNROLLED = kernel.Plan("unrolled", block=4, warps=1)
TABLE, DT = TABLEAUS["tsit5"], jnp.asarray(0.01)
CASES = [("cart_pole", UNROLLED)]
CASES += [(name, ROLLED) for name in ("cart_pole", "free_body", "mixed")]
CASES += [pytest.param(n, ROLLED, marks=pytest.mark.slow) for n in ("walker", "two roots")]


def lowered_for_a_gpu(f, *args) -> None:
    """Which none of this machine's need be."""
    gpu = AbstractDevice("NVIDIA H200", 132, "gpu")
    with use_abstract_mesh(AbstractMesh((1,), ("x",), abstract_device=gpu)):
        jax.jit(f).trace(*args).lower(lowering_platforms=("cuda",))


def load(name: str) -> rb.Model:
    return rb.load(WRITTEN.get(name, name))


def batch(model: rb.Model, size: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    states = jax.vmap(model.random_state)(jax.random.split(key, size))
    return states.q.T, states.v.T


@pytest.mark.parametrize("closed", [True, False], ids=["closed over", "argument"])
@pytest.mark.parametrize("name, how", CASES, ids=str)
def test_forward_dynamics(name, how, closed, key):
    model = load(name) if closed else load(name).fix_zeros()
    q, v = batch(model, 6, key)  # two blocks, the second padded
    tau = jax.random.normal(key, v.shape)

    def run(model, *x):
        return kernel.forward_dynamics(model, *x, how=how)

    f = jax.jit(lambda *x: run(model, *x)) if closed else lambda *x: jax.jit(run)(model, *x)
    expected = jax.jit(acceleration)(model, q, v, tau)
    np.testing.assert_allclose(f(q, v, tau), expected, rtol=1e-10, atol=1e-10)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("walker", "mixed")]


@pytest.mark.parametrize("name", ["cart_pole", "double_pendulum", *SLOW])
def test_rollout_and_its_gradient(name, key):
    model = load(name)
    q, v = (x.T for x in batch(model, 3, key))
    ctrls = jax.random.normal(key, (3, 4, model.nu))

    def loss(q, v, ctrls, kernel):
        out = rb.rollout(model, rb.State(q, v), ctrls, 0.01, save_every=2, kernel=kernel)
        return (out.q[:, -1] ** 2).sum() + (out.v[:, 1] ** 2).sum()

    found, expected = (
        jax.jit(jax.value_and_grad(lambda *x, k=k: loss(*x, k), argnums=(0, 1, 2)))(q, v, ctrls)
        for k in (True, False)
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), found, expected
    )


STAGED = [("pendulum", UNROLLED), ("quadrotor", UNROLLED), ("free_body", ROLLED)]
STAGED += [
    pytest.param(name, how, marks=pytest.mark.slow)
    for name, how in (("spinning_top", UNROLLED), ("walker", ROLLED))
]


@pytest.mark.parametrize("name, how", STAGED, ids=str)
def test_stages(name, how, key):
    """A Runge-Kutta method in the kernel, its stages written out or in a loop, actuators at sites
    among them."""
    model = load(name)
    q, v = batch(model, 3, key)
    ctrls = jax.random.uniform(key, (4, model.nu, 3))
    run = jax.jit(lambda q, v: march(model, applied_lanes, q, v, ctrls, DT, 4, 2, how, TABLE))
    state, each = rb.State(q.T, v.T), jnp.moveaxis(ctrls, -1, 0)
    expected = rb.rollout(model, state, each, DT, integrator="tsit5", save_every=2, kernel=False)
    for found, wanted in zip(run(q, v), (expected.q, expected.v), strict=True):
        np.testing.assert_allclose(jnp.moveaxis(found, -1, 0), wanted[:, 1:], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("how", [UNROLLED, ROLLED], ids=str)
def test_stages_of_every_method(how, key):
    model = load("pendulum")
    q, v = batch(model, 3, key)
    for name, table in TABLEAUS.items():
        run = partial(march, model, applied_lanes, ctrls=None, dt=DT, steps=2, save_every=1)
        state = rb.State(q.T, v.T)
        wanted = rb.rollout(model, state, None, DT, integrator=name, steps=2, kernel=False)
        got = jnp.moveaxis(jax.jit(partial(run, how=how, table=table))(q, v)[0], -1, 0)
        np.testing.assert_allclose(got, wanted.q[:, 1:], rtol=1e-12, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_gradient_of_stages_is_the_scans(key):
    model = load("cart_pole")
    q, v = (x.T for x in batch(model, 2, key))

    def loss(v, kernel):
        out = rb.rollout(
            model, rb.State(q, v), None, 0.01, steps=2, integrator="rk4", kernel=kernel
        )
        return (out.q**2).sum()

    found, expected = (jax.jit(jax.grad(loss), static_argnums=1)(v, k) for k in (True, False))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("precision", [jnp.float32, jnp.float64], ids=["f32", "f64"])
@pytest.mark.parametrize(
    "name, how",
    [
        ("pendulum", kernel.Plan("unrolled")),
        ("quadrotor", kernel.Plan("unrolled")),
        ("walker", kernel.ROLLED),
    ],
    ids=str,
)
def test_triton_takes_stages(name, how, precision, monkeypatch):
    monkeypatch.setattr(kernel, "INTERPRET", False)
    model = load(name)
    with jax.enable_x64(precision == jnp.float64):
        q, v, ctrls = (
            jnp.zeros(s, precision) for s in [(model.nq, 512), (model.nv, 512), (4, model.nu, 512)]
        )

        def run(q, v, ctrls):
            return march(model, applied_lanes, q, v, ctrls, jnp.asarray(DT, precision), 4, 2,
                         how, TABLE)  # fmt: skip

        lowered_for_a_gpu(run, q, v, ctrls)


def test_gradient_of_the_model_is_the_scans(key):
    model = load("cart_pole")
    q, v = (x.T for x in batch(model, 2, key))

    def loss(mass, kernel):
        heavier = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(heavier, rb.State(q, v), None, 0.01, steps=2, kernel=kernel)
        return (out.q**2).sum()

    found, expected = (jax.grad(loss)(model.bodies.mass, k) for k in (True, False))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_no_kernel_takes(key):
    model = load("cart_pole")
    with pytest.raises(InputError, match="kernel is True"):
        rb.rollout(model, model.default_state(), None, 0.01, steps=2, kernel=True)


@pytest.mark.parametrize(
    "name, how", [("cart_pole", kernel.Plan("unrolled")), ("walker", kernel.ROLLED)], ids=str
)
def test_triton_takes_them(name, how, monkeypatch):
    monkeypatch.setattr(kernel, "INTERPRET", False)
    model = load(name)
    shapes = [(model.nq, 512), (model.nv, 512), (10, model.nu, 512)]
    with jax.enable_x64(False):
        q, v, ctrls = (jnp.zeros(s, jnp.float32) for s in shapes)

        def loss(q, v, ctrls):
            qs, vs = kernel_gradient.rollout(
                model, q, v, ctrls, jnp.float32(0.01), applied=applied_lanes, scan=None, steps=10,
                save_every=5, how=how,
            )  # fmt: skip
            return (qs**2).sum() + (vs**2).sum()

        lowered_for_a_gpu(jax.grad(loss, (0, 1, 2)), q, v, ctrls)


def test_a_tangent_is_refused_in_a_sentence(key):
    """Outside of jit; inside, JAX's own error comes too late to be put in other words."""
    model = load("cart_pole")
    q, v = (x.T for x in batch(model, 2, key))

    def run(v):
        return rb.rollout(model, rb.State(q, v), None, 0.01, steps=2, kernel=True).q

    for transform in (lambda f: jax.jvp(f, (v,), (v,)), lambda f: jax.jacfwd(f)(v)):
        with pytest.raises(InputError, match="kernel=False"):
            transform(run)
