"""Poses that a Panda's hand can reach within its joint ranges; this file is no benchmark."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp

import rbjax as rb
import rbjax.control
from benchmarks.cases.models import MODELS
from benchmarks.shared.robots import NAMES

URDF = str(MODELS[NAMES["panda"]].path)
BASE, HAND = "panda_link0", "panda_hand"


def panda() -> rb.Model:
    """The arm as its file has it: with joint ranges, and frames that are welded to links."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rb.load(URDF)


def reachable(model: rb.Model, count: int, seed: int = 7, dtype: Any = None) -> tuple:
    """R (count, 3, 3), p (count, 3) of the hand in configurations uniform within the ranges."""
    ranges = model.joints.range.astype(dtype or jnp.result_type(float))
    unit = jax.random.uniform(jax.random.key(seed), (count, model.nq), ranges.dtype)
    q = ranges[:, 0] + (ranges[:, 1] - ranges[:, 0]) * unit
    poses = jax.jit(jax.vmap(lambda q: rb.forward_kinematics(model, q)))(q)
    hand = model.body(HAND)
    return poses.R[:, hand], poses.p[:, hand]
