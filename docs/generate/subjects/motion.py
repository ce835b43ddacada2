"""On a GPU: forward dynamics, rollouts, gradients, contacts, loops, forces, wheels."""

from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Pivot, Table

ROBOTS = ("panda", "humanoid", "g1", "tree60")
RATE = C("M/s median", "million a second")
THREADS = "python -m benchmarks.gpu.threads"
MOTION = ("forward", "forward f64", "rollout", "rollout, policy", "simulate")
GRADIENTS = (
    "gradient by controls",
    "gradient by masses",
    "gradient by own masses",
    "gradient by weights",
    "gradient of 1000 steps, 2 GiB",
    "gradient of 1000 steps, 64 GiB",
    "forward dynamics derivatives",
    "inverse dynamics derivatives",
)
ALGORITHMS = (
    "inverse dynamics",
    "mass matrix",
    "inverse mass matrix",
    "forward kinematics",
    "jacobian",
    "energy",
    "regressor",
)
CONTACT_PARTS = (
    "rollout",
    "free",
    "scan, rollout",
    "scan, free",
    "gradient, rollout",
    "gradient, free",
    "mjx, 4 Newton steps",
)
THREAD_FILES = tuple(f"gpu-threads-{robot}-nvidia-h200" for robot in ROBOTS)
MJX_FILES = tuple(f"gpu-mjx-{robot}-nvidia-h200" for robot in ROBOTS)
WHAT, ENGINE, ROBOT, BATCH = C("what", ""), C("engine"), C("robot"), C("batch")
COMPILED = C(lambda row: row["lower_s"] + row["compile_s"], "seconds of tracing and compiling")


def on_gpu(what: tuple[str, ...]) -> Pivot:
    return Pivot(THREAD_FILES, (WHAT,), "robot", RATE, THREADS, {"what": what}, order=ROBOTS)


TABLES = {
    "gpu motion": on_gpu(MOTION),
    "gpu algorithms": on_gpu(ALGORITHMS),
    "gpu gradients": on_gpu(GRADIENTS),
    "gpu gradient errors": Table(
        THREAD_FILES,
        (ROBOT, C("what", ""), C("error median", "median"), C("error max", "largest")),
        THREADS,
        lambda row: row.get("error median") is not None,
    ),
    "mjx": Pivot(
        MJX_FILES,
        (ENGINE, WHAT),
        "robot",
        C("M/s", "million a second"),
        "python -m benchmarks.gpu.mjx",
        {"what": ("forward", "rollout", "gradient")},
        order=ROBOTS,
    ),
    "warp forward": Table(
        ("gpu-warp-forward-*",),
        (
            ROBOT,
            BATCH,
            C("M/s", "million a second"),
            C("version", "version of MuJoCo Warp"),
            C("compile_s", "compiling, s"),
        ),
        "python -m benchmarks.gpu.mujoco_warp --robots --forward panda humanoid g1",
        optional=True,
    ),
    "gpu compile": Pivot(
        (*THREAD_FILES, *MJX_FILES),
        (ENGINE, WHAT),
        "robot",
        COMPILED,
        THREADS + ", benchmarks.gpu.mjx",
        lambda row: (
            row["what"] in ("forward", "rollout", "gradient", "gradient by controls")
            and row["engine"] != "frax"
        ),
        min,
        ROBOTS,
    ),
    "panda on an H100": Table(
        ("gpu-threads-panda-nvidia-h100*",),
        (WHAT, BATCH, RATE),
        THREADS,
        lambda row: row.get("M/s median") is not None,
    ),
    "two GPUs": Table(
        ("gpu-sharded*",),
        (WHAT, ENGINE, BATCH, C("M/s median", "million a second"), C("over one", "over one GPU")),
        "python -m benchmarks.gpu.sharded",
    ),
    "force elements": Pivot(
        ("elements-*",),
        (ROBOT, C("what", "with")),
        "run",
        C("M/s", "million steps a second"),
        "python -m benchmarks.gpu.elements",
        order=("rollout", "gradient"),
    ),
    "loops": Table(
        ("loops-*",),
        (
            C(lambda row: "Cassie" if "cassie" in row["file"] else "four-bar", "robot"),
            ENGINE,
            WHAT,
            BATCH,
            C("M/s", "million a second"),
            C("rows left", "gap, m"),
            COMPILED,
        ),
        "python -m benchmarks.gpu.loops four_bar cassie.xml",
    ),
    "gpu contact": Pivot(
        ("gpu-contact-*",),
        (C("on"), ROBOT),
        "what",
        RATE,
        order=CONTACT_PARTS,
    ),
    "warp contact": Table(
        ("gpu-warp-contact-*",),
        (
            ROBOT,
            C("what", "solver"),
            BATCH,
            C("M/s median", "million a second"),
            C("rows a world", "constraint rows a robot"),
            C("version", "version of MuJoCo Warp"),
            C("compile_s", "compiling, s"),
        ),
        "python -m benchmarks.gpu.mujoco_warp --robots humanoid humanoid_feet go1.xml g1.xml",
        optional=True,
    ),
    "gpu contact compile": Pivot(
        ("gpu-contact-*",),
        (C("on"), ROBOT),
        "what",
        COMPILED,
        order=CONTACT_PARTS,
        best=min,
    ),
    "cpu contact": Table(
        ("cpu-contact-amd*",),
        (
            ROBOT,
            C("contact_us", "a step, us"),
            C("mj_step_us", "mj_step, us"),
            C("over_mujoco", "over mj_step"),
            C("batch_us", "in a batch of 64, us"),
            C("free_us", "without contacts, us"),
            C("contacts at the end"),
            C("contact_compile_s", "compiling, s"),
        ),
    ),
    "contact parity": Table(
        ("contact-parity*",),
        (
            ROBOT,
            C("states"),
            C("whole", "worst of a state, relative"),
            C("entry", "worst of an entry"),
            C("entry, corrected"),
            C("MuJoCo, by a rounding"),
            C("rbjax, by a rounding"),
        ),
    ),
    "cube": Table(
        ("cpu-contact-cube*",),
        (
            C("model"),
            C("mean", "mean error, mm"),
            C("end", "error at the end, mm"),
            C("friction"),
            C("half side", "half side, m"),
            C("status"),
        ),
    ),
    "contact map": Pivot(
        ("contact-map*",),
        (C("scene"), C("dt", "dt, s")),
        "law",
        C("error", "the error of the scene", 2),
        best=max,
    ),
    "gpu wheels": Pivot(
        ("gpu-wheeled*",),
        (C("what", ""), C("robot is", "numbers are")),
        "method",
        RATE,
        "python -m benchmarks.gpu.wheeled",
        order=("semi_implicit_euler", "rk4"),
    ),
    "cpu wheels": Pivot(
        ("cpu-wheeled*",),
        (C("what", ""), C("robot is", "numbers are")),
        "method",
        C("M steps/s", "million steps a second"),
        "python -m benchmarks.cpu.wheeled",
        lambda row: "method" in row,
        order=("semi_implicit_euler", "rk4"),
    ),
    "cpu wheels limit": Pivot(
        ("cpu-wheeled*", "gpu-wheeled*"),
        (C("on"), C("what", ""), C("robot is", "numbers are")),
        "method",
        C("of limit", "the machine's limit", 2),
        "python -m benchmarks.cpu.wheeled, benchmarks.gpu.wheeled",
        lambda row: "method" in row,
        order=("semi_implicit_euler", "rk4"),
    ),
    "wheel contact": Pivot(
        ("wheel-contact*",),
        (C("title", "robot"), C("time_constant", "time constant, s")),
        "engine",
        C("distance", "metres from rolling after 4 s", 2),
        where=lambda row: row.get("sweep") == "stiffness",
        best=min,
    ),
    "wheel laws": Pivot(
        ("wheel-contact*",),
        (C("shape", "wheels"), C("width", "width"), C("dt", "step, s")),
        "engine",
        C("distance", "metres from rolling after 4 s, differential drive", 2),
        where=lambda row: row.get("sweep") == "laws",
    ),
    "wheel times": Table(
        ("wheel-contact*",),
        (
            C("title", "robot"),
            C("engine"),
            C("integrator"),
            C("dt", "step, s"),
            C("time_constant", "time constant, s"),
            C("distance", "metres from rolling", 2),
            C("seconds", "ms of computing a second", 2, 1e3),
        ),
        where=lambda row: (
            row.get("sweep", "").startswith("dt")
            and row["integrator"] in ("rk4", "implicitfast")
            and row["dt"] in (0.02, 0.002, 0.001)
        ),
    ),
}
