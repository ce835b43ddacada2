"""Operations are counted by the rule that its docstring states."""

import jax
import jax.numpy as jnp
import mujoco
import pytest

import rbjax as rb
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import traced
from rbjax.dynamics.tracing.operations import OperationCount, leaf_names, operation_count
from rbjax.lanes import fusion_barrier, sincos
from tests.forces.test_drivers import TWO_ARMED
from tests.oracles.random_actuators import random_actuated
from tests.robots import load_quietly

ELEMENTS = {
    name for name, kind in vars(rb.forces).items()
    if name in rb.forces.__all__ and isinstance(kind, type) and issubclass(kind, rb.forces.Element)
} - {"Element"}  # fmt: skip

ONCE = jax.ShapeDtypeStruct((), float)


def in_threads(x: jax.Array) -> jax.Array:
    """What a GPU has in the place of `jax.vmap(lambda x: x * x + 1)`."""
    return run(traced(lambda x: [x * x + 1], ONCE), [x], x.shape, [(0,)])[0]


COUNTED = {
    "a kernel": (in_threads, OperationCount(3, 3)),
    "array": (lambda x: x * x + 2.0 * x, OperationCount(3, 6)),
    "dead code": (lambda x: (jnp.exp(x), x + 1)[1], OperationCount(3)),
    "power": (lambda x: x**5, OperationCount(0, 9)),
    "inverse square": (lambda x: x**-2, OperationCount(0, 3, 3)),
    "root": (lambda x: jnp.sqrt(x) / 2, OperationCount(0, 0, 3, 3)),
    "sum": (lambda x: x.sum(), OperationCount(2)),
    "dot": (lambda x: jnp.dot(x, x), OperationCount(2, 3)),
    "moved, compared, chosen": (lambda x: jnp.where(x > 0, x[::-1], -x), OperationCount()),
    "jit": (jax.jit(lambda x: jnp.sin(x) * 2), OperationCount(0, 3, 0, 0, 3)),
    "sine and cosine": (lambda x: sincos(x[0])[0] + sincos(x[0])[1], OperationCount(1, 0, 0, 0, 2)),
    "fusion_barrier": (lambda x: fusion_barrier((x * 2, jnp.exp(x)))[0], OperationCount(0, 3)),
    "loop": (
        lambda x: jax.lax.scan(lambda c, y: (c * y, c + y), 1.0, x)[0],
        OperationCount(0, 3),
    ),
    "branch": (
        lambda x: jax.lax.cond(x[0] > 0, lambda y: y * y * y, lambda y: y, x),
        OperationCount(0, 6),
    ),
    "Cholesky": (
        lambda x: jnp.linalg.cholesky(jnp.diag(x), symmetrize_input=False),
        OperationCount(4, 4, 3, 3),
    ),
    "triangle": (
        lambda x: jax.scipy.linalg.solve_triangular(jnp.diag(x), x),
        OperationCount(3, 3, 3),
    ),
    "LU": (lambda x: jax.lax.linalg.lu(jnp.diag(x))[0], OperationCount(5, 5, 3)),
    "whole numbers": (lambda x: jnp.argmax(x) + 3, OperationCount()),
    "checkpoint": (jax.checkpoint(lambda x: x + 1), OperationCount(3)),
}


@pytest.mark.parametrize("name", COUNTED)
def test_small_functions(name: str) -> None:
    fn, expected = COUNTED[name]
    assert operation_count(fn, jnp.ones(3)) == expected


def test_a_closed_over_model_costs_only_what_moves() -> None:
    """A pendulum: tau = I a + m g l sin q."""
    model, x = rb.load("pendulum"), jnp.ones(1)
    closed = operation_count(rb.gravity_forces, model, x).total
    assert closed <= 5
    traced = operation_count(rb.gravity_forces, model, x, traced=("bodies.mass",))
    assert traced.total > closed


def test_leaves_have_names() -> None:
    model = rb.load("pendulum")
    assert {"bodies.mass", "joints.damping", "gravity"} <= set(leaf_names(model))
    with pytest.raises(rb.UnknownName, match=r"bodies\.mass"):
        operation_count(rb.gravity_forces, model, jnp.ones(1), traced=("bodies.weight",))


@pytest.mark.parametrize("f", [jnp.fft.rfft, lambda x: jnp.linalg.eigvalsh(jnp.diag(x))])
def test_what_has_no_count_is_refused(f) -> None:
    with pytest.raises(rb.InputError, match=r"primitive '(fft|eigh)', which returns .* not known"):
        operation_count(f, jnp.ones(3))


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
def test_our_elements_have_counts(driver: str) -> None:
    """All that act in files with every actuator, spring and fluid, over a step."""
    fluid = """<mujoco><option density="1.2" viscosity="0.1"/><worldbody><body><freejoint/>
      <geom type="ellipsoid" size="0.1 0.2 0.3" fluidshape="{}"/></body></worldbody></mujoco>"""
    arms = load_quietly(mujoco.MjModel.from_xml_string(TWO_ARMED), limits=True, friction=True)
    ends = [rb.forces.Place.on(body=name) for name in ("left", "right")]
    one = [j for j in arms.joint_names if arms.q_slice(j).stop - arms.q_slice(j).start == 1][:1]
    sprung = arms.with_forces(
        rb.forces.Bushing.of(*ends, stiffness=3.0, damping=1.0),
        rb.forces.PointSpring.of(*ends, stiffness=3.0),
        rb.forces.GearLoss.of(arms, one, 0.1),
        rb.forces.JointCurves.of(arms, one, (-1.0, 1.0), torque=0.3, coulomb=0.1),
    )
    immersed = [load_quietly(fluid.format(shape)) for shape in ("ellipsoid", "none")]
    segments = """<mujoco><worldbody><body name="a"><geom size=".1" mass="1"/>
      <body name="b" pos="1 0 0"><joint name="bend" type="ball"/><geom size=".1" mass="1"/></body>
      </body></worldbody></mujoco>"""
    rope = load_quietly(segments)
    rope = rope.with_forces(rb.forces.Cable.of(rope, ["bend"], twist=1.0, bend=1.0, radius=0.01))
    names = set()
    for model in (sprung, rope, load_quietly(random_actuated(0)), *immersed):
        model = model.replace(driver=driver)
        state = model.random_state(jax.random.key(0))
        names |= {type(element).__name__ for element in model.forces}

        def after(state, u, model=model):
            return rb.step(model, state, u, 0.01)

        assert operation_count(after, state, jnp.ones(model.nu)).total > 0
    assert names >= ELEMENTS
