"""A user's own force elements, for tests of functions that take elements."""

import jax
import jax.numpy as jnp

import rbjax as rb


class Wind(rb.forces.Element):
    """A drag on the first body, in air that moves."""

    air: jax.Array
    drag: jax.Array

    def loads(self, context):
        body = context.body(0)
        return body.push(self.drag * (self.air - body.velocity))


class Lag(rb.forces.Element):
    """A force on the second velocity coordinate that follows sin t with a delay."""

    delay: jax.Array

    @property
    def size(self) -> int:
        return 1

    def loads(self, context):
        return rb.forces.Loads({1: context.x[0]})

    def rate(self, context):
        return [(jnp.sin(context.t) - context.x[0]) / self.delay]
