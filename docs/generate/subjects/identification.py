"""Identification: simulated and real recordings, intervals, derivatives of simulation errors."""

from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Table


def _named(row: dict) -> str:
    """The causes that were named; of one kind in many joints, their number."""
    causes = row["named"].split("; ")
    kind = " ".join(causes[0].split()[:2])
    return row["named"] if len(causes) < 3 else f"{kind} of {len(causes)} joints"


TABLES = {
    "identification": Table(
        ("cpu-identification-*", "gpu-identification-*"),
        (
            C("on"),
            C("problem"),
            C("engine"),
            C("unknowns"),
            C("first_s", "first fit, s"),
            C("again_s", "again, s"),
            C("rollouts"),
            C("evaluations"),
            C("error", digits=1),
            C("inside", "inside the 95 % intervals"),
            C("note"),
        ),
        "python -m benchmarks.cpu.identification, benchmarks.gpu.identification",
    ),
    "intervals": Table(
        ("cpu-intervals-double*", "cpu-intervals-cart*", "cpu-intervals-arm7*"),
        (
            C("robot"),
            C("unknowns"),
            C("experiments"),
            C("coverage"),
            C("lowest", "lowest of a number"),
            C("highest", "highest of a number"),
            C("ratio", "scatter over sigma"),
            C("seconds"),
        ),
        "python -m benchmarks.cpu.intervals --full",
    ),
    "interval settings": Table(
        ("cpu-intervals-settings-*",),
        (
            C("setting"),
            C("experiments"),
            C("coverage"),
            C("lowest"),
            C("highest"),
            C("scatter over sigma"),
        ),
        "python -m benchmarks.cpu.intervals settings --full",
    ),
    "arm from a hundred recordings": Table(
        ("cpu-identify-arm-truth-*",),
        (
            C("draw"),
            C("seconds"),
            C("evaluations"),
            C("inside", "inside, of 8"),
            C("worst", "worst, sigmas"),
            C("r2", "R2", 6),
            C("tries"),
            C("steps", "step, s"),
        ),
        "python -m benchmarks.cpu.identify_arm_truth",
    ),
    "legs in the air": Table(
        ("cpu-legs-in-the-air-*",),
        (
            C("part"),
            C("model"),
            C("unknowns"),
            C("fitted", "fitted half, mrad"),
            C("unseen", "unseen half, mrad"),
            C("rollouts"),
            C("seconds"),
        ),
        "python -m benchmarks.cpu.legs_in_the_air --full",
    ),
    "wrong data": Table(
        ("cpu-wrong-data-*",),
        (
            C(lambda row: "leg" if "leg" in row["file"] else "quadruped", "robot"),
            C("wrong", "mistake"),
            C("loss"),
            C(_named, "named"),
            C("error", digits=2),
            C("error, corrected", digits=2),
            C("seconds", digits=2),
        ),
    ),
    "double pendulum motors": Table(
        ("cpu-double-pendulum-motors-*",),
        (
            C("design"),
            C("cutoff", "low-pass, Hz"),
            C("model"),
            C("R2 shoulder", digits=4),
            C("R2 elbow", digits=4),
            C("worst run shoulder"),
            C("worst run elbow"),
        ),
        "python -m benchmarks.cpu.double_pendulum_motors",
    ),
    "pendulum data": Table(
        ("cpu-pendulum-data-*",),
        (
            C("pendulum"),
            C("piece"),
            C("found 1.5", "ours, 1.5 s, mrad"),
            C("published 1.5", "published, mrad"),
            C("found 0.5", "ours, 0.5 s start, mrad"),
            C("published 0.5", "published, mrad"),
        ),
        "python -m benchmarks.cpu.pendulum_data",
    ),
    "slip by floor": Table(
        ("cpu-slip_by_floor-*",),
        (
            C("floor"),
            C("model"),
            C("unknowns"),
            C("runs"),
            C("mean", "mean, %", 2),
            C("each", "a single run, %", 2),
            C("worst", "worst, %", 2),
            C("repeats", "repeats differ by, %", 2),
            C("fit_s", "fit, s"),
        ),
        "python -m benchmarks.cpu.slip_by_floor",
    ),
    "sysid jacobian": Table(
        ("gpu-sysid-jacobian-*",),
        (
            C("engine"),
            C("recordings"),
            C("steps"),
            C("unknowns"),
            C("run_s", "run, ms", 3, 1e3),
            C("ratio", "over MJX"),
            C("peak GB", "memory, GB"),
            C(lambda row: row["lower_s"] + row["compile_s"], "compiling, s"),
        ),
        "python -m benchmarks.gpu.sysid_jacobian",
    ),
}
