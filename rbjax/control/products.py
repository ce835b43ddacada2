"""Products of matrices in full precision: by default a GPU multiplies f32 matrices in TF32."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""A B, or A x."""
