"""Every public function of the package under jit, vmap, jvp and vjp; a missing one fails."""

import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import rotations
from rbjax.rotations import incremental, quaternion, screws, se3, so3
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, GRADIENT, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit
RNG = np.random.default_rng(0)
VECTOR, OTHER = RNG.normal(size=(2, 3, 3))
TWIST, MOTION = RNG.normal(size=(2, 3, 6))
QUATERNION, TURN = (np.asarray(quaternion.exp(v)) for v in (VECTOR, OTHER))
ROTATION, SECOND = (np.asarray(so3.exp(v)) for v in (VECTOR, OTHER))
POSE, NEXT = (np.asarray(se3.exp(x)) for x in (TWIST, MOTION))
S, M, M4 = RNG.uniform(size=3), RNG.normal(size=(3, 3, 3)), RNG.normal(size=(3, 4, 4))

CASES: dict[str, tuple] = {
    "so3.hat": (VECTOR,), "so3.vee": (M,), "so3.exp": (VECTOR,), "so3.log": (ROTATION,),
    "so3.compose": (ROTATION, SECOND), "so3.inverse": (ROTATION,),
    "so3.distance": (ROTATION, SECOND), "so3.interpolate": (ROTATION, SECOND, S),
    "so3.project": (M,), "so3.projection_margin": (M,),
    "quaternion.multiply": (QUATERNION, TURN), "quaternion.conjugate": (QUATERNION,),
    "quaternion.normalize": (QUATERNION,), "quaternion.rotate": (QUATERNION, VECTOR),
    "quaternion.to_matrix": (QUATERNION,), "quaternion.from_matrix": (ROTATION,),
    "quaternion.exp": (VECTOR,), "quaternion.log": (QUATERNION,),
    "quaternion.angle": (QUATERNION,), "quaternion.distance": (QUATERNION, TURN),
    "quaternion.interpolate": (QUATERNION, TURN, S),
    "se3.pose": (ROTATION, VECTOR), "se3.hat": (TWIST,), "se3.vee": (M4,), "se3.exp": (TWIST,),
    "se3.log": (POSE,), "se3.compose": (POSE, NEXT), "se3.inverse": (POSE,),
    "se3.interpolate": (POSE, NEXT, S), "se3.distance": (POSE, NEXT), "se3.adjoint": (POSE,),
    "se3.ad": (TWIST,), "se3.rate_from_body_twist": (POSE, TWIST),
    "se3.rate_from_space_twist": (POSE, TWIST), "se3.body_twist": (POSE, M4),
    "se3.space_twist": (POSE, M4), "screws.from_twist": (TWIST,),
    "screws.to_twist": (VECTOR, OTHER, S, S + 1), "mrp_shadow": (VECTOR,), "mrp_short": (VECTOR,),
    "incremental.start": (QUATERNION,),
}  # fmt: skip
for side in ("left", "right", "inverse_left", "inverse_right"):
    CASES |= {f"{room}.{side}_jacobian": (VECTOR,) for room in ("so3", "quaternion")}
    CASES[f"se3.{side}_jacobian"] = (TWIST,)

ELSEWHERE = {  # not functions of arrays alone, and who tests them
    "convert": "test_representation.py",
    "representations": "test_representation.py",
    **dict.fromkeys(("so3.identity", "quaternion.identity", "se3.identity"), "used everywhere"),
    **dict.fromkeys(("so3.random", "quaternion.random"), "test_so3.py"),
    **dict.fromkeys(("quaternion.product", "quaternion.turned"), "test_quaternion.py"),
    **{f"quaternion.{n}_lanes": "array forms" for n in ("exp", "log", "angle", "from_matrix")},
    **{f"incremental.{n}": "its own" for n in ("attitude", "rate", "fold", "integrate")},
}  # fmt: skip


def public() -> dict[str, Any]:
    found = {n: getattr(rotations, n) for n in rotations.__all__}
    for room in (so3, quaternion, se3, screws, incremental):
        short = room.__name__.rpartition(".")[2]
        found |= {f"{short}.{n}": getattr(room, n) for n in room.__all__}
    return {n: f for n, f in found.items() if inspect.isroutine(f)}


def test_no_public_function_is_missing() -> None:
    missing = public().keys() - CASES.keys() - ELSEWHERE.keys()
    assert not missing, f"give {sorted(missing)} a case in tests/rotations/test_public.py"
    assert CASES.keys() | ELSEWHERE.keys() <= public().keys()
    assert all(f.__doc__ for f in public().values())


@pytest.mark.parametrize("name", CASES)
def test_composes(name: str) -> None:
    """Along the set on which the arguments live, matrices and quaternions included."""
    f, xs = public()[name], CASES[name]

    def flat(*arrays):
        leaves = jax.tree.leaves(f(*arrays))
        return jnp.concatenate([jnp.ravel(x) for x in leaves])

    rng = np.random.default_rng(1)
    tangents = [_tangent(x[0], rng) for x in xs]
    door = [np.asarray(flat(*(x[k] for x in xs))) for k in range(3)]  # values checked, compiled
    weight = rng.normal(size=door[0].shape)

    def everything(tangents, weight, *batch):
        first = [x[0] for x in batch]
        rate = jax.jvp(flat, first, tangents)[1]
        ends = [flat(*(x + s * STEP * t for x, t in zip(first, tangents, strict=True)))
                for s in (-1, 1)]  # fmt: skip
        together = [jnp.reshape(x, (3, -1)) for x in jax.tree.leaves(f(*batch))]
        reverse = jax.vjp(flat, *first)[1](weight)
        return jax.vmap(flat)(*batch), jnp.concatenate(together, 1), rate, ends, reverse

    run = jax.jit(everything)
    mapped, together, rate, ends, gradient = run(tangents, weight, *xs)
    assert relative_error(mapped, np.stack(door), batch_dims=1).max() <= F64_TRANSFORM, "vmap, jit"
    assert relative_error(together, np.stack(door), batch_dims=1).max() <= F64_TRANSFORM, "axes"
    difference = (np.asarray(ends[1]) - np.asarray(ends[0])) / (2 * STEP)
    assert relative_error(rate, difference, floor=1.0) <= GRADIENT, "jvp"
    by_reverse = sum((g * t).sum() for g, t in zip(gradient, tangents, strict=True))
    assert abs(by_reverse - weight @ rate) <= F64_IDENTITY * max(1.0, np.abs(weight * rate).max())


def _tangent(x, rng):
    d = rng.normal(size=x.shape)
    if x.shape in ((3, 3), (4, 4)) and np.allclose(x[:3, :3] @ x[:3, :3].T, np.eye(3)):
        d[:3, :3] = x[:3, :3] @ np.asarray(so3.hat(d[0, :3]))
        d[3:] = 0
    return d
