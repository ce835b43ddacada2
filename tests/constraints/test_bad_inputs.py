"""What is no constraint is refused, with a sentence, where it is made or first used."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc

MODEL = rb.load("double_pendulum")
HERE, LOWER = rc.Place.on(), rc.Place.on(body="lower")


class TwoOfOne(rc.Constraint):
    size = 2

    def rows(self, context: rb.forces.Context) -> Sequence[rc.Row]:
        return [rc.coordinate(context, "elbow")]


class Numbers(rc.Constraint):
    size = 1

    def rows(self, context: rb.forces.Context) -> Sequence[rc.Row]:
        return [3.0]  # type: ignore[list-item]


MADE: dict[str, Callable] = {
    "a is 1, expected a Place": lambda: rc.Spherical(1, LOWER),
    "KnifeEdge: b is 1": lambda: rc.KnifeEdge(HERE, 1),
    "RollingDisc: a is 1": lambda: rc.RollingDisc(1, 2, 0.1),
    "PointOnCurve: a is 1": lambda: rc.PointOnCurve(1, 2, lambda s: s, [0.0]),
    "PointOnSurface: a is 1": lambda: rc.PointOnSurface(1, 2, lambda x: x),
    "body is True": lambda: rc.Place.on(body=True),
    "expected a direction": lambda: rc.Place.on(axis=[0, 0, 0]),
    "point.0. is nan": lambda: rc.Place.on(point=[np.nan, 0, 0]),
    "length=...): got nan": lambda: rc.Distance(HERE, LOWER, np.nan),
    "length=...): got str": lambda: rc.Distance(HERE, LOWER, "long"),
    "length=...): got -1.0, expected a number above zero": lambda: rc.Distance(HERE, LOWER, -1.0),
    "pitch=...): got str": lambda: rc.Screw.between(MODEL, None, "lower", pitch="a"),
    "got the numbers .'pitch'., expected ..": lambda: rc.Weld.between(
        MODEL, None, "lower", pitch=1.0
    ),
    "got the numbers .., expected .'pitch'.": lambda: rc.Screw.between(MODEL, None, "lower"),
    "Distance.between: got one point, expected two": lambda: rc.Distance.between(
        MODEL, "upper", "lower", length=1.0
    ),
    "Frame: got neither of body and site": lambda: rc.Spherical(HERE, rb.Frame()),
    "Frame: got both of body and site": lambda: rc.Spherical(rb.Frame("a", None, "b"), HERE),
    "got a geom or a center": lambda: rc.Spherical(rb.Frame(geom="a"), HERE),
    "an rb.Frame as b": lambda: rc.Distance.between(MODEL, rb.Frame("upper"), "lower"),
    "point and other are both": lambda: rc.Distance.between(
        MODEL, "upper", "lower", other=[0, 0, 0]
    ),
    "pitch=...): got 0, expected": lambda: rc.Screw(HERE, LOWER, 0.0),
    "method=...): got 'kkt', expected Method": lambda: rc.Formulation("kkt"),
    "feedback=...): got 5.0, expected Baumgarte or None": lambda: rc.Formulation(feedback=5.0),
    "projection=...): got True, expected Projection": lambda: rc.Formulation(projection=True),
    "Index3 has no feedback": lambda: rc.Formulation(rc.Index3(), rc.Baumgarte()),
    "Baumgarte: alpha is nan": lambda: rc.Baumgarte(np.nan),
    "Baumgarte: beta is '3'": lambda: rc.Baumgarte(1.0, "3"),
    "Baumgarte.for_step: dt is 0": lambda: rc.Baumgarte.for_step(0),
    "Penalty: stiffness is -1.0": lambda: rc.Penalty(-1.0),
    "Projection: iterations is 0": lambda: rc.Projection(iterations=0),
    "AugmentedLagrangian: iterations is 1.5": lambda: rc.AugmentedLagrangian(iterations=1.5),
    "ratio=...): got nan": lambda: rc.Gear("elbow", "shoulder", np.nan),
    "radius=...): got the shape .2,., expected a number": lambda: rc.Rack("a", "b", [1.0, 2.0]),
    "radius=...): got -1.0": lambda: rc.RollingSphere(HERE, LOWER, -1.0),
    "coefficients=...): got str": lambda: rc.JointPolynomial("elbow", "shoulder", "c"),
    "coefficients=...): got the shape .0,.": lambda: rc.JointPolynomial("elbow", "shoulder", []),
    "starts=...): got the shape ..,": lambda: rc.PointOnCurve(HERE, LOWER, lambda s: s, 0.0),
    "function=...): got int, expected a function": lambda: rc.Prescribed("elbow", 3),
}
USED: dict[str, rc.Constraint] = {
    "unknown joint 'knee'": rc.Gear("knee", "shoulder", 2.0),
    "function returned the shape .2,., expected": rc.Prescribed("elbow", lambda t: jnp.zeros(2)),
    "f returned the shape .2,., expected .1,.": rc.Holonomic(lambda t, q: q),
    "returned 1 rows, expected its size, 2": TwoOfOne(),
    "returned a float among its rows, expected a Row": Numbers(),
}


@pytest.mark.parametrize("message", MADE)
def test_refused_where_it_is_made(message: str) -> None:
    with pytest.raises(rb.InputError, match=message.replace("(", r"\(").replace(")", r"\)")):
        MADE[message]()


@pytest.mark.parametrize("message", USED)
def test_refused_where_it_is_used(message: str) -> None:
    with pytest.raises((rb.InputError, rb.UnknownName), match=message):
        rc.residual(MODEL.with_constraints(USED[message]), MODEL.default_state())


@pytest.mark.parametrize("model, state", [(3, MODEL.default_state()), (MODEL, [1.0])])
def test_assemble_wants_a_model_and_a_state(model: object, state: object) -> None:
    with pytest.raises(rb.InputError, match="assemble: "):
        rc.assemble(model, state)  # type: ignore[arg-type]
