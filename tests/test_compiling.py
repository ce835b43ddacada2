"""The options are known to this jaxlib, change no result, and stay out of another `jit`."""

import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiling import takes
from tests.tolerances import F64_ROUNDING


def test_every_option_is_known_and_an_unknown_one_is_told() -> None:
    options = rb.compiler_options()
    assert options and all(takes(name, value) for name, value in options.items())
    assert not takes("xla_cpu_no_such_option", True)


def rolled(model, start):
    return rb.rollout(model, start, dt=0.01, integrator="rk4", steps=8, save_every=8).q[-1]


def simulated(model, start):
    solve = {"dt0": 0.01, "adjoint": diffrax.ForwardMode()}
    return rb.simulate(model, start, jnp.array([0.0, 0.08]), **solve).q[-1]


@pytest.mark.parametrize("march", [rolled, simulated])
def test_motion_is_the_same_alone_within_jit_and_differentiated(march) -> None:
    """Alone it is compiled with options, which JAX refuses inside of another `jit`."""
    model = rb.load("double_pendulum")
    start = rb.State(jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4]))

    def end(state):
        return march(model, state)

    alone = end(start)
    within = jax.jit(lambda: end(start))()  # nothing of it is traced, but the program around it is
    np.testing.assert_allclose(within, alone, atol=F64_ROUNDING)
    np.testing.assert_allclose(jax.jit(end)(start), alone, atol=F64_ROUNDING)
    rate = jax.jvp(end, (start,), (start,))[1]
    _, linear = jax.linearize(end, start)
    np.testing.assert_allclose(jax.jit(linear)(start), rate, atol=F64_ROUNDING)


def test_rbjax_may_be_imported_within_a_program() -> None:
    """What stands around a call is told by what stood around the import."""
    code = """
import jax
def f(x):
    import rbjax as rb
    model = rb.load("pendulum")
    return x * rb.mass_matrix(model, model.default_state().q)
print(jax.jit(f)(0.0), f(0.0))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert out.stdout.split() == ["[[0.]]", "[[0.]]"], out.stderr
