"""A Panda's inverse kinematics within its joint ranges, f64, one core, beside other solvers.

    python -m benchmarks.cpu.inverse_kinematics [POSES]

All are given the same poses, which random configurations within the ranges reach, and the same
first configuration. A pose counts as solved where Pinocchio's forward kinematics of the answer is
within 1e-6 m and 1e-6 rad of it, and the answer within the ranges: ours exactly, those of the peers
to 1e-5 rad, which TRAC-IK exceeds them by at most. The peers are OptIK (Rust and
NLopt, `pip install optik-py`), TRAC-IK (C++, `pip install pytracik`) and the loop of Pinocchio's
own example of closed-loop inverse kinematics with restarts (Python around its C++). Times are the
process' seconds of computing, a pose.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import rbjax as rb
from benchmarks.shared.arm_poses import BASE, HAND, URDF, panda, reachable
from benchmarks.shared.timing import markdown_table, save

TOLERANCE = 1e-6
COLUMNS = ("solver", "poses", "solved", "us", "us median", "us worst", "compile_s", "turns")


class Judge:
    """Pinocchio's forward kinematics."""

    def __init__(self, slack: float = 0.0) -> None:
        self.slack = slack
        self.model = pin.buildModelFromUrdf(URDF)
        self.data = self.model.createData()
        self.frame = self.model.getFrameId(HAND)

    def solved(self, q: Any, R: np.ndarray, p: np.ndarray) -> bool:
        if q is None or not np.isfinite(q).all():
            return False
        low, high = self.model.lowerPositionLimit, self.model.upperPositionLimit
        pin.framesForwardKinematics(self.model, self.data, np.asarray(q, float))
        pose = self.data.oMf[self.frame]
        off = np.linalg.norm(pin.log3(R @ pose.rotation.T)), np.linalg.norm(p - pose.translation)
        within = (low - q <= self.slack).all() and (q - high <= self.slack).all()
        return bool(within and max(off) <= TOLERANCE)


def one_by_one(name: str, solve: Callable, judge: Judge, R: Any, p: Any) -> dict[str, Any]:
    """A row of a solver of one pose."""
    times, met = [], 0
    for i in range(len(R)):
        start = time.process_time()
        q = solve(R[i], p[i])
        times.append(time.process_time() - start)
        met += judge.solved(q, R[i], p[i])
    us = np.array(times) * 1e6
    return {"solver": name, "poses": len(R), "solved": met / len(R), "us": us.mean(),
            "us median": float(np.median(us)), "us worst": us.max()}  # fmt: skip


def ours(judge: Judge, R: np.ndarray, p: np.ndarray) -> Iterator[dict[str, Any]]:
    model = panda()

    def one(R: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = rb.control.inverse_kinematics(model, (R, p), body=HAND, tolerance=0.9 * TOLERANCE)
        return found.q, found.iterations

    start = time.perf_counter()
    run = jax.jit(jax.vmap(one)).lower(R, p).compile()
    compile_s = time.perf_counter() - start
    q, turns = run(R, p)
    times = []
    for _ in range(15):
        start = time.process_time()
        jax.block_until_ready(run(R, p))
        times.append(time.process_time() - start)
    us = float(np.median(times)) / len(R) * 1e6
    met = sum(judge.solved(*x) for x in zip(np.asarray(q), R, p, strict=True))
    yield {"solver": "rbjax, all at once", "poses": len(R), "solved": met / len(R),
           "us": us, "compile_s": compile_s, "turns": float(np.mean(turns))}  # fmt: skip
    start = time.perf_counter()
    act = rb.compile(lambda R, p: one(R, p)[0], R[0], p[0])
    compile_s = time.perf_counter() - start
    assert act.native
    row = one_by_one("rbjax, one by one (rb.compile)", act, judge, R, p)
    yield row | {"compile_s": compile_s}


def optik(judge: Judge, R: np.ndarray, p: np.ndarray, first: np.ndarray) -> Iterator[dict]:
    try:
        import optik as peer
    except ImportError:
        print("OptIK is missing: pip install optik-py")
        return
    robot = peer.Robot.from_urdf_file(URDF, BASE, HAND)
    robot.set_parallelism(1)
    # its objective is a squared error; a tenth of the tolerance, for a rounded sum of both parts
    config = peer.SolverConfig(solution_mode="speed", max_time=1.0, tol_f=(0.5 * TOLERANCE) ** 2,
                               tol_df=-1.0, tol_dx=-1.0)  # fmt: skip

    def solve(R: np.ndarray, p: np.ndarray) -> Any:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p
        found = robot.ik(config, T.tolist(), first.tolist())
        return None if found is None else np.array(found[0])

    yield one_by_one("OptIK", solve, judge, R, p)


def trac_ik(judge: Judge, R: np.ndarray, p: np.ndarray, first: np.ndarray) -> Iterator[dict]:
    try:
        import pytracik as peer
    except ImportError:
        print("TRAC-IK is missing: pip install pytracik")
        return
    text = Path(URDF).read_text()
    speed = peer.SolveType.Speed
    # its error is per component, in its own axes: half the tolerance keeps the norm below it
    solver = peer.TRAC_IK(BASE, HAND, text, 0.5, 0.5 * TOLERANCE, speed)

    def solve(R: np.ndarray, p: np.ndarray) -> Any:
        x, y, z, w = pin.Quaternion(R).coeffs()
        found = peer.ik(solver, first, *p, x, y, z, w)
        return found[1:] if found[0] >= 0 else None

    yield one_by_one("TRAC-IK", solve, judge, R, p)


def closed_loop(judge: Judge, R: np.ndarray, p: np.ndarray, first: np.ndarray) -> Iterator[dict]:
    """Pinocchio's example (`examples/inverse-kinematics.py`: damping 1e-12, step 0.1 of Newton's,
    here the full step, which converges sooner), clipped to the ranges, from up to 64 starts."""
    model, data = judge.model, judge.model.createData()
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    rng = np.random.default_rng(0)

    def solve(R: np.ndarray, p: np.ndarray) -> Any:
        target, q = pin.SE3(R, p), first.copy()
        for _ in range(64):
            for _ in range(40):
                pin.forwardKinematics(model, data, q)
                pose = pin.updateFramePlacement(model, data, judge.frame)
                error = pin.log6(pose.actInv(target)).vector
                if np.linalg.norm(error) < 0.5 * TOLERANCE:
                    return q
                J = pin.computeFrameJacobian(model, data, q, judge.frame)
                v = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error)
                q = np.clip(pin.integrate(model, q, np.clip(v, -1, 1)), low, high)
            q = rng.uniform(low, high)
        return None

    yield one_by_one("Pinocchio's loop, restarts", solve, judge, R, p)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("poses", nargs="?", type=int, default=1000)
    count = parser.parse_args().poses
    judge = Judge()
    R, p = (np.asarray(x) for x in reachable(panda(), count, dtype=jnp.float64))
    first = (judge.model.lowerPositionLimit + judge.model.upperPositionLimit) / 2
    rows = [*ours(judge, R, p)]
    judge = Judge(slack=1e-5)
    for peer in (optik, trac_ik, closed_loop):
        rows += peer(judge, R, p, first)
    fastest = min(row["us"] for row in rows[2:])
    rows = [row | {"over the fastest peer": fastest / row["us"]} for row in rows]
    print(markdown_table(rows, (*COLUMNS, "over the fastest peer")))
    print(save("cpu-inverse-kinematics", rows))


if __name__ == "__main__":
    main()
