"""Identification: an arm with 55 unknowns beside mujoco.sysid, a quadruped in the air with 49
beside CMA-ES.

`python -m benchmarks.cpu.identification [arm] [quadruped] [search] [--rollouts N]` writes
results/cpu-identification-<processor>.json. "search" is CMA-ES, and runs where it is named. The
quadruped's files lie beside the repository, or in `--data FOLDER`; where they are not, it is left
out.

first_s, first_cpu_s (seconds of all threads) are of the first call, with tracing and compiling;
again_s, again_cpu_s of a second call of the same shapes: for the arm other commands and another
first guess, for the quadruped another first guess. compiled counts programs that the second call
compiled.
The error is that of the combinations that can be found; sigmas is the largest error of a number
that is found by itself, over its own sigma; inside, how many of the numbers lie in their 95 %
intervals.

mujoco.sysid (of MuJoCo 4) fits its own recording of the same arm under the same commands, with the
same spread of first guesses: five armatures, then all 55 numbers, its inertias by its own
pseudo-inertia (written by `with_inertia`). It needs the packages of `pip install mujoco[sysid]`;
without them its rows say so.
CMA-ES has the same unknowns, first guess and squares; a rollout is a simulated motion, and a
direction of a Jacobian counts as one, too.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402

from benchmarks.cases import problems  # noqa: E402
from benchmarks.cases.problems import ORACLES, Problem, arm, quadruped  # noqa: E402
from benchmarks.shared.cma_es import cma_es  # noqa: E402
from benchmarks.shared.timing import markdown_table, others, save  # noqa: E402
from rbjax.sysid import identify  # noqa: E402
from rbjax.sysid.parameters.unknown_vector import Unknowns  # noqa: E402
from rbjax.sysid.simulation.runs import make_batch  # noqa: E402
from rbjax.sysid.simulation.simulation_error import SimulationError  # noqa: E402

COLUMNS = (
    "problem", "engine", "unknowns", "found", "evaluations", "rollouts", "first_s", "first_cpu_s",
    "again_s", "again_cpu_s", "compiled", "error", "sigmas", "inside", "note",
)  # fmt: skip
COMPILED = "/jax/core/compile/backend_compile_duration"
compilations = [0]


def count(event: str, _: float, **__: Any) -> None:
    compilations[0] += event == COMPILED


def ours(name: str, problem: Problem, other: Problem) -> dict[str, Any]:
    cpu, start = time.process_time(), time.perf_counter()
    found = identify(problem.setup, problem.run, problem.unknowns, **problem.how)
    first, first_cpu = time.perf_counter() - start, time.process_time() - cpu
    before, cpu, start = compilations[0], time.process_time(), time.perf_counter()
    identify(other.setup, other.run, other.unknowns, **other.how)
    again, cpu = time.perf_counter() - start, time.process_time() - cpu
    p, truth = np.array([*found.values.values()]), problem.truth
    off = np.abs(found.identifiable.combine(p) - found.identifiable.combine(truth))
    sigma = found.estimates.sigma
    row = {
        "problem": name, "engine": "rbjax", "unknowns": len(truth),
        "found": found.identifiable.rank,
        "evaluations": found.evaluations, "rollouts": found.evaluations * (1 + len(truth)),
        "first_s": first, "first_cpu_s": first_cpu, "again_s": again, "again_cpu_s": cpu,
        "compiled": compilations[0] - before, "error": float(off.max()), "ok": found.success,
    }  # fmt: skip
    if max(map(np.max, found.rms.values())) > 1e-6:
        shown = np.isfinite(sigma)
        row["sigmas"] = float(np.abs((p - truth) / sigma)[shown].max())
        intervals = [found.estimates.interval(name) for name in found.values]
        within = [x.low <= t <= x.high for x, t in zip(intervals, truth, strict=True)]
        row["inside"] = int(sum(within))
    return row


def guessed_again(problem: Problem) -> Problem:
    """The same from another first guess."""
    of = Unknowns.of("again", problem.unknowns, problem.setup)
    p = of.read(problem.setup) * 1.05
    return problem._replace(setup=of.write(problem.setup, p))


def peer(problem: Problem, numbers: int) -> dict[str, Any]:
    """mujoco.sysid on five armatures, or on all 55 numbers."""
    row = {"problem": f"arm, {numbers} numbers", "engine": "mujoco.sysid", "unknowns": numbers}
    try:
        from mujoco.sysid import InertiaType, Parameter, optimize
    except ImportError as error:
        reason = str(error).removesuffix(f" ({error.path})")  # no path of this machine
        return row | {"note": f"not run: {reason}; pip install mujoco[sysid]"}
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(json.loads((ORACLES / "arm5.json").read_text())["mjcf"])
    for kind, called in ((mujoco.mjtSensor.mjSENS_JOINTPOS, "q"),
                         (mujoco.mjtSensor.mjSENS_JOINTVEL, "v")):  # fmt: skip
        for joint in spec.joints:
            spec.add_sensor(
                name=f"{called} {joint.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=joint.name,
            )  # fmt: skip
    model = spec.compile()
    data, ctrl = mujoco.MjData(model), np.asarray(problem.run["ctrl"].values)
    start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    state, seen = (np.squeeze(x, 0) for x in mujoco.rollout.rollout(model, data, start, ctrl[:-1]))
    t = np.arange(len(ctrl)) * model.opt.timestep
    sequence = sysid.ModelSequences(
        "arm", spec, "motion", start, sysid.TimeSeries(t, ctrl),
        sysid.TimeSeries.from_names(state[:, 0], seen, model),
    )  # fmt: skip
    sought = sysid.ParameterDict()

    def armature(spec: Any, p: Any, name: str) -> None:
        spec.joint(name).armature = p.value[0]

    true = {joint.name: float(joint.armature) for joint in spec.joints}
    for name, value in true.items():
        sought.add(Parameter(
            name, nominal=value, min_value=0.001, max_value=1.0,
            modifier=lambda spec, p, name=name: armature(spec, p, name),
        ))  # fmt: skip
        sought[name].value[:] = 0.01
    if numbers > 5:
        rng = np.random.default_rng(0)
        for body in spec.bodies[1:]:
            write = functools.partial(with_inertia, body.name)
            p = sysid.body_inertia_param(spec, model, body.name, InertiaType.Pseudo, modifier=write)
            sought.add(p)
            moved = p.value + 0.1 * rng.normal(size=10)
            p.value[:] = np.clip(moved, p.min_value + 1e-3, p.max_value - 1e-3)
    evaluations = [0]
    built = sysid.build_residual_fn(models_sequences=[sequence])

    def residual(x: Any, params: Any, **how: Any) -> Any:
        evaluations[0] += 1 if np.ndim(x) == 1 else np.shape(x)[1]
        return built(x, params, **how)

    cpu, start_s = time.process_time(), time.perf_counter()
    try:
        found, _ = optimize(sought, residual, optimizer="mujoco", verbose=False, max_iters=100)
    except Exception as error:  # its own failure is the result
        row["note"] = f"{type(error).__name__}: {str(error)[:120]}"
    else:
        off = [abs(found[name].value[0] - value) for name, value in true.items()]
        row["error"], row["note"] = float(max(off)), "error of the armatures"
    seconds, cpu = time.perf_counter() - start_s, time.process_time() - cpu
    return row | {"again_s": seconds, "again_cpu_s": cpu, "rollouts": evaluations[0]}


def with_inertia(name: str, spec: Any, p: Any) -> None:
    """Writes a pseudo-inertia as principal axes: MuJoCo 4.0 refuses what mujoco.sysid writes."""
    from mujoco.sysid._src.model_modifier import pi_from_theta

    pi, body = pi_from_theta(p.value), spec.body(name)
    com = pi[1:4] / pi[0]
    about = pi[4:].reshape(3, 3) - pi[0] * (com @ com * np.eye(3) - np.outer(com, com))
    moments, axes = np.linalg.eigh(about)
    axes[:, 0] *= np.linalg.det(axes)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.mass, body.ipos, body.inertia, body.iquat = pi[0], com, moments, quaternion
    body.explicitinertial = True


def searched(name: str, problem: Problem, budget: int) -> dict[str, Any]:
    """CMA-ES; positive numbers in the logarithm, bounded ones in the logit."""
    setup, run, unknowns, truth, how = problem
    of = Unknowns.of("search", unknowns, setup)
    error = SimulationError(setup, of, make_batch(setup, [run], how["grid"]), how["grid"])
    guess, limits = np.asarray(of.read(setup)), of.limits(setup)
    low, high = (np.array([limits.get(n, (-np.inf, np.inf))[k] for n in of.names]) for k in (0, 1))
    positive = np.isfinite(low) & np.isinf(high)
    bounded = np.isfinite(low) & np.isfinite(high)
    span, least = np.where(bounded, high - low, 1.0), np.where(bounded, low, 0.0)
    share = np.where(bounded, (guess - least) / span, 0.5)

    def numbers(y: jax.Array) -> jax.Array:
        within = least + span * jax.nn.sigmoid(y + np.log(share / (1 - share)))
        return jnp.where(positive, guess * jnp.exp(y), jnp.where(bounded, within, guess + 0.1 * y))

    @jax.jit
    def squares(y: jax.Array) -> jax.Array:
        f = lambda y: (error.programs.residuals(numbers(y)[None], error.runs) ** 2).sum()  # noqa: E731
        return jax.vmap(f)(y)

    cpu, start = time.process_time(), time.perf_counter()
    best, used = cma_es(lambda y: np.asarray(squares(jnp.asarray(y))), guess.size, 0.3, budget)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    p = np.asarray(numbers(jnp.asarray(best)))
    R = error.triangle(truth)
    sigma = np.sqrt(np.diag(np.linalg.inv(R[:, :-1].T @ R[:, :-1])))
    r, r_true = error.residuals(p), error.residuals(truth)
    return {
        "problem": name, "engine": "CMA-ES", "unknowns": guess.size, "rollouts": used,
        "evaluations": used, "first_s": seconds, "first_cpu_s": cpu,
        "error": float(np.abs(p - truth).max()),
        "sigmas": float((np.abs(p - truth) / sigma).max()),
        "note": f"squares {float((r**2).sum() / (r_true**2).sum()):.4g} times those of the truth",
    }  # fmt: skip


def rows(parts: list[str], budget: int) -> Iterator[dict[str, Any]]:
    if "arm" in parts:
        problem = arm()
        yield ours("arm, 55 numbers", problem, arm(1))
        yield peer(problem, 5)
        yield peer(problem, 55)
    if problems.GO2.exists():
        if "quadruped" in parts:
            problem = quadruped()
            yield ours("quadruped", problem, guessed_again(problem))
        if "search" in parts:
            yield searched("quadruped", quadruped(), budget)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", default=["arm", "quadruped"])
    parser.add_argument("--rollouts", type=int, default=6400, help="of CMA-ES")
    parser.add_argument("--data", type=Path, default=problems.GO2, help="the quadruped's files")
    asked = parser.parse_args()
    problems.GO2 = asked.data
    jax.monitoring.register_event_duration_secs_listener(count)
    found = []
    for row in rows(asked.parts, asked.rollouts):
        print(row, flush=True)
        found.append(row)
    print(markdown_table(found, COLUMNS))
    save("cpu-identification", found + others("cpu-identification", found, ("problem", "engine")))
