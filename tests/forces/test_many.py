"""One force on many bodies is the sum of the forces on each."""

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

    def loads(self, now):
        return sum(
            (self.act(now.body(b), self.drag[b], self.force[b]) for b in range(now.model.nb)),
            Loads(),
        )

    def act(self, body, drag, force):
        return body.push(force - body.velocity * drag, at=body.at([0.1, 0.0, 0.2]).position)


class Together(OneByOne):
    def loads(self, now):
        return rb.forces.on_each(now, range(now.model.nb), self.act, self.drag, self.force)


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
