"""A user's own force elements, for tests of functions that take elements."""

import jax
import jax.numpy as jnp

import rbjax as rb


class Wind(rb.forces.Element):
    """A drag on the first body, in air that moves."""

    air: jax.Array
    drag: jax.Array

    def loads(self, now):
        body = now.body(0)
        return body.push(self.drag * (self.air - body.velocity))


class Lag(rb.forces.Element):
    """A force on the second velocity coordinate that follows sin t with a delay."""

    delay: jax.Array

    @property
    def size(self) -> int:
        return 1

    def loads(self, now):
        return rb.forces.Loads({1: now.x[0]})

    def rate(self, now):
        return [(jnp.sin(now.t) - now.x[0]) / self.delay]
