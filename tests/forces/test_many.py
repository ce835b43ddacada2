"""One force on many bodies is the sum of the forces on each."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces import Element, Loads
from tests.robots import robot
from tests.tolerances import F64_IDENTITY, relative_error


class OneByOne(Element):
    """A drag and a constant force on each body, written body by body."""

    drag: jax.Array
    force: jax.Array

    def loads(self, context):
        return sum(
            (
                self.act(context.body(b), self.drag[b], self.force[b])
                for b in range(context.model.nb)
            ),
            Loads(),
        )

    def act(self, body, drag, force):
        return body.push(force - body.velocity * drag, at=body.at([0.1, 0.0, 0.2]).position)


class Together(OneByOne):
    def loads(self, context):
        return rb.forces.on_each(context, range(context.model.nb), self.act, self.drag, self.force)


@pytest.mark.parametrize("driver", ["unrolled", "rolled", "limbs"])
def test_the_sum_is_the_same(driver):
    model = robot("small", driver).model
    q, v = (x[0] for x in robot("small").states(1))
    rng = np.random.default_rng(0)
    numbers = jnp.asarray(rng.uniform(1, 2, model.nb)), jnp.asarray(rng.normal(size=(model.nb, 3)))
    found, want = (
        rb.applied_forces(model.with_forces(kind(*numbers)), rb.State(q, v))
        for kind in (Together, OneByOne)
    )
    assert relative_error(found, want) < F64_IDENTITY


class More(Element):
    """On each body a force, and what a loop over bodies does not cover: another body, a joint, or
    an acceleration."""

    k: jax.Array
    what: str = eqx.field(static=True)

    def loads(self, context):
        first = context.model.joint_names[-1]

        def act(body, k):
            own = body.push(rb.lanes.Vec3(0.0, k, 0.0))
            if self.what == "joint":
                return own + context.joint(first).push(k)
            if self.what == "body":
                return own + context.body(0).at([0.0, 0.0, 0.3]).push(rb.lanes.Vec3(k, 0.0, 0.0))
            tip = body.at([0.1, 0.0, 0.2])
            return tip.push(tip.acceleration * k)

        return rb.forces.on_each(context, range(context.model.nb), act, self.k)


@pytest.mark.parametrize("what", ["joint", "body", "acceleration"])
def test_what_a_loop_does_not_cover_does_not_depend_on_the_driver(what):
    found = []
    for driver in ("unrolled", "rolled", "limbs"):
        model = rb.load("double_pendulum").replace(driver=driver)
        model = model.with_forces(More(jnp.array([1.0, 2.0]), what))
        state = rb.State(jnp.array([0.3, 1.0]), jnp.array([0.5, -0.2]))
        found.append(np.asarray(rb.applied_forces(model, state)))
    assert np.abs(found[0]).max() > 1e-2
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-12)
