"""Every robot at every fidelity as a program of one sample, as on a GPU, beside XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.model import State
from tests.compiler.host import by_xla, many_on_host
from tests.tolerances import F64_TRANSFORM, relative_error

KINDS = wheeled.kinds()


def test_reduced_rollouts():
    beside_xla("omni_3", [f for f in wheeled.fidelities() if f != "constrained"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_rollouts(kind):
    beside_xla(kind, wheeled.fidelities())


def beside_xla(kind, fidelities):
    """By both Euler methods, of a batch of states and controls that differ."""
    cases, rng = [], np.random.default_rng(0)
    for fidelity in fidelities:
        servo = wheeled.SpeedServo(1.0) if fidelity == "kinematic" else None
        robot = KINDS[kind].make(motor=servo)
        vehicle = wheeled.at(robot, fidelity)
        state = wheeled.start(vehicle, twist=[0.4, 0.0, 0.1])
        args = [x + 0.01 * rng.normal(size=(2, *x.shape)) for x in jax.tree.leaves(state)]
        args.append(0.1 * rng.normal(size=(2, 3, vehicle.nu)))
        methods = ["semi_implicit_euler"]
        if fidelity == "slipping":
            methods.append("linearly_implicit_euler")
        for method in methods:

            def end(*args, vehicle=vehicle, method=method):
                *state, u = args
                out = wheeled.rollout(vehicle, State(*state), u, 0.002, integrator=method)
                return jnp.concatenate([x[-1] for x in (out.q, out.v, out.x) if x is not None])

            cases.append((end, tuple(args)))
    for found, wanted in zip(many_on_host(cases), by_xla(cases), strict=True):
        assert np.isfinite(wanted).all()
        assert relative_error(found, wanted) <= F64_TRANSFORM
