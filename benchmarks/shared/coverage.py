"""Experiments whose truth is known, for the share of 95 % intervals that hold it: eight settings of
precision, noise and loss, each fitted as a user would, by `identify` with its defaults."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Grid, Identified, Recording, Setup, Unknown, identify
from rbjax.sysid.simulation.setup import simulate_motion
from rbjax.sysid.statistics.precision import cast

STEP, COUNT, NOISE = 0.01, 200, 2e-3  # s, samples, rad and m


class Setting(NamedTuple):
    """dtype of the model; whether the noise is stated; kind: "normal", "outliers" (5 %, 10 to 30
    times the noise, loss="huber") or "dry" (Coulomb friction of the cart is sought too)."""

    dtype: str
    stated: bool
    kind: str

    @property
    def name(self) -> str:
        return f"{self.dtype}, {'stated' if self.stated else 'estimated'}, {self.kind}"


SETTINGS = [
    *(Setting(d, s, "normal") for d in ("f32", "f64") for s in (True, False)),
    *(Setting("f32", s, "outliers") for s in (True, False)),
    *(Setting("f32", s, "dry") for s in (True, False)),
]


def robot(kind: str) -> tuple[rb.Model, dict[str, Any], np.ndarray]:
    """The true robot in float64, what is sought, and its true values."""
    model = rb.load("cart_pole")
    model = model.replace(joints=model.joints.replace(damping=jnp.array([0.6, 0.02])))
    sought: dict[str, Any] = {
        "mass": Unknown("bodies.mass", positive=True),
        "damping": Unknown("joints.damping"),
    }
    truth = [*np.asarray(model.bodies.mass), 0.6, 0.02]
    if kind == "dry":
        dry = rb.forces.JointFriction.of(model, model.joint_names[:1], coulomb=0.8, smoothing=0.02)
        model = model.with_forces(dry)
        sought["coulomb"] = Unknown("forces.0.coulomb", positive=True)
        truth.append(0.8)
    return model, sought, np.array(truth)


def experiments(setting: Setting, count: int, seed: int = 0) -> Iterator[tuple[Identified, Any]]:
    """So many fits, each with noise of its own, and the truth."""
    with jax.enable_x64(True):
        model, sought, truth = robot(setting.kind)
        model = cast(model, np.float64)
        setup, grid = Setup.of(model), Grid(STEP, 8)
        t = np.arange(COUNT + 1) * STEP
        push = 4 * np.sin(2 * np.pi * (1 + 0.5 * t[:-1]) * t[:-1])[:, None]
        start = rb.State(jnp.array([0.0, 2.6]), jnp.array([0.1, -0.2]))
        path = simulate_motion(lambda p: setup, jnp.zeros(1), start, jnp.asarray(push), grid)
        clean = np.asarray(path.q)
        guess = model.replace(
            bodies=model.bodies.replace(mass=model.bodies.mass * jnp.array([1.4, 0.7])),
            joints=model.joints.replace(damping=jnp.array([0.3, 0.05])),
        )
        if setting.kind == "dry":
            dry = guess.forces[0].replace(coulomb=jnp.array([0.4]))
            guess = guess.replace(forces=(dry,))
        guess = cast(guess, np.float32 if setting.dtype == "f32" else np.float64)
    loss = "huber" if setting.kind == "outliers" else "squares"
    rng = np.random.default_rng(seed)
    wide = setting.dtype == "f64"
    for _ in range(count):
        noise = NOISE * rng.normal(size=clean.shape)
        if setting.kind == "outliers":
            out = rng.random(clean.shape) < 0.05
            size = rng.choice([-1, 1], clean.shape) * rng.uniform(10, 30, clean.shape)
            noise += out * NOISE * size
        q = Channel(t, clean + noise, noise=np.full(2, NOISE) if setting.stated else None)
        run = Recording("push", {"q": q, "ctrl": Channel(t[:-1], push)})
        with jax.enable_x64(wide):
            yield identify(guess, run, sought, loss=loss), truth


def coverage(setting: Setting, count: int, seed: int = 0) -> dict[str, Any]:
    """The share of intervals that hold the truth, of all numbers and of the single ones."""
    inside, failed, good, ratio = [], 0, 0, []
    for found, truth in experiments(setting, count, seed):
        spans = [found.estimates.interval(name) for name in found.values]
        inside.append([x.low <= y <= x.high for x, y in zip(spans, truth, strict=True)])
        ratio.append([(x.value - y) / x.sigma for x, y in zip(spans, truth, strict=True)])
        failed += not found.success
        good += found.verdict.success
    each, z = np.mean(inside, 0), np.array(ratio)
    return {
        "setting": setting.name, "unknowns": len(each), "experiments": count,
        "coverage": float(each.mean()), "lowest": float(each.min()), "highest": float(each.max()),
        "scatter over sigma": f"{z.std(0).min():.2f} to {z.std(0).max():.2f}",
        "failed": failed, "good": good,
    }  # fmt: skip
