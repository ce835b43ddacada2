"""Errors of rotation libraries at and near the singular points of rotations, in f64.

`python -m benchmarks.accuracy.rotation_libraries`, after `pip install jaxlie pytransform3d`; a
missing library is skipped. Errors are the worst of 500 samples with fixed seeds. Attitudes are
compared with their originals, derivatives with those of rbjax, which the tests compare with a
hundred digits. Results go to results/; the notebook tumbling_body quotes them.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.shared.timing import markdown_table, save
from rbjax.rotations import quaternion, representations, se3, so3

Array = np.ndarray
MANY = 500
LOCK = (1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 0.0)  # rad from gimbal lock
TURNS = (0.0, 1e-6, 1.0, np.pi - 1e-5, np.pi - 1e-7, np.pi)


def apart(R: Array, X: Array) -> float:
    """The largest angle between attitudes (n, 3, 3)."""
    return float(np.linalg.norm(so3.log(np.swapaxes(R, 1, 2) @ X), axis=1).max())


def turns(angle: float) -> Array:
    """Rotation vectors (n, 3) of that length."""
    axes = np.random.default_rng(1).normal(size=(MANY, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


def locked(d: float) -> Array:
    """Attitudes (n, 3, 3), d from where intrinsic z-y-x angles are in gimbal lock."""
    angles = np.random.default_rng(0).uniform(-3, 3, (MANY, 3))
    angles[:, 1] = np.pi / 2 - d
    return np.asarray(representations()["intrinsic_zyx"].to_matrix(angles))


Trips = dict[str, Callable[[Array], Array]]  # library -> round trip, (n, 3, 3)


def euler() -> Trips:
    zyx = representations()["intrinsic_zyx"]

    def scipys(R: Array) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says "Gimbal lock detected"
            return Rotation.from_euler("ZYX", Rotation.from_matrix(R).as_euler("ZYX")).as_matrix()

    out: Trips = {"rbjax": lambda R: np.asarray(zyx.to_matrix(zyx.from_matrix(R))), "scipy": scipys}
    if importlib.util.find_spec("pytransform3d"):
        from pytransform3d import rotations as other

        def one(R: Array) -> Array:
            angles = other.euler_from_matrix(R, 2, 1, 0, extrinsic=False)
            return other.matrix_from_euler(angles, 2, 1, 0, extrinsic=False)

        out["pytransform3d"] = lambda R: np.stack([one(r) for r in R])
    return out


def logarithm() -> Trips:
    out: Trips = {
        "rbjax": lambda R: np.asarray(so3.exp(so3.log(R))),
        "scipy": lambda R: Rotation.from_rotvec(Rotation.from_matrix(R).as_rotvec()).as_matrix(),
    }
    if importlib.util.find_spec("pytransform3d"):
        from pytransform3d import rotations as other

        out["pytransform3d"] = lambda R: np.stack([
            other.matrix_from_axis_angle(other.axis_angle_from_matrix(r)) for r in R
        ])  # fmt: skip
    if importlib.util.find_spec("jaxlie"):
        from jaxlie import SO3

        trip = jax.jit(jax.vmap(lambda R: SO3.exp(SO3.from_matrix(R).log()).as_matrix()))
        out["jaxlie"] = lambda R: np.asarray(trip(jnp.asarray(R)))
    return out


def derivatives() -> Iterator[tuple[str, str, float | str]]:
    """(what, where, error) of jaxlie's SE(3), whose twists have the translation first."""
    from jaxlie import SE3

    rho = np.random.default_rng(2).normal(size=(MANY, 3))
    rho /= np.linalg.norm(rho, axis=1, keepdims=True)

    def ours(xi: jax.Array) -> jax.Array:
        return se3.exp(xi)[:3, 3]

    def theirs(xi: jax.Array) -> jax.Array:
        return SE3.exp(jnp.concatenate([xi[3:], xi[:3]])).translation()

    for order, name in ((1, "first"), (2, "second")):
        both = []
        for f in (ours, theirs):
            for _ in range(order):
                f = jax.jacfwd(f)
            both.append(jax.jit(jax.vmap(f)))
        for angle in (0.0, 1e-3, 1e-2, 1e-1):
            xi = np.concatenate([turns(angle), rho], 1)
            a, b = (np.asarray(f(xi)) for f in both)
            yield f"SE3.exp, {name} derivatives", f"turn {angle:g}", float(np.abs(a - b).max())
    forward, reverse = (
        jax.jit(mode(lambda xi: SE3.exp(xi).jlog()))(jnp.zeros(6))
        for mode in (jax.jacfwd, jax.jacrev)
    )
    off = float(jnp.abs(forward - reverse).max())
    yield "SE3.jlog, reverse mode", "identity", "nan" if np.isnan(off) else off


def main() -> None:
    rows: list[dict[str, Any]] = []

    def add(library: str, what: str, where: str, error: float | str) -> None:
        release = "this one" if library == "rbjax" else version(library)
        row = {"library": library, "version": release, "what": what, "where": where}
        rows.append(row | {"error": error})

    for library, trip in euler().items():
        for d in LOCK:
            R = locked(d)
            add(
                library,
                "zyx angles and back",
                f"{d:.0e} from lock" if d else "in lock",
                apart(R, trip(R)),
            )
    for library, trip in logarithm().items():
        for t in TURNS:
            R = np.asarray(quaternion.to_matrix(quaternion.exp(turns(t))))
            near = f"turn pi - {np.pi - t:.0e}" if t < np.pi else "half a turn"
            where = near if t > 3 else f"turn {t:g}"
            add(library, "logarithm and back", where, apart(R, trip(R)))
    if importlib.util.find_spec("jaxlie"):
        for what, where, error in derivatives():
            add("jaxlie", what, where, error)
    print(markdown_table(rows, rows[0]))
    print(save("rotation-libraries", rows))


if __name__ == "__main__":
    main()
