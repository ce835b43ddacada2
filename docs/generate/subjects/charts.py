"""The charts of the benchmark pages, by the names of their files."""

from docs.generate.figures import FIGURES
from docs.generate.subjects.bars import Bars, Dots

NAMES = {"panda": "Panda, 7 dof", "humanoid": "humanoid, 23 dof", "g1": "G1, 35 dof"}
STANDING = {
    "humanoid_feet": "humanoid, two feet",
    "humanoid": "humanoid, all shapes",
    "go1": "Go1, four feet",
    "g1": "G1, five pairs",
}


def against_mjx(part: str) -> dict[str, dict[str, str]]:
    return {
        title: {"rbjax": f"gpu.{part}.{robot}", "MJX": f"gpu.{part}.{robot}.mjx"}
        for robot, title in NAMES.items()
    }


def on_the_floor(robot: str) -> dict[str, str]:
    rate = f"gpu.contact.{robot}"
    out = {"rbjax": f"{rate}.rollout", "MuJoCo Warp": f"{rate}.warp", "MJX": f"{rate}.mjx"}
    out["rbjax without contacts"] = f"{rate}.free"
    return {series: name for series, name in out.items() if name in FIGURES}


CHARTS = {
    "forward_dynamics.svg": Bars(
        "Forward dynamics on an H200, f32", "million a second", against_mjx("forward")
    ),
    "rollouts.svg": Bars(
        "Steps of a rollout on an H200, f32", "million a second", against_mjx("rollout")
    ),
    "gradients.svg": Bars(
        "Steps of a rollout with its gradient by the controls, H200, f32",
        "million a second",
        against_mjx("gradient"),
    ),
    "contact.svg": Bars(
        "Steps of robots on the floor, f32; rbjax on an H100, others on an H200",
        "million a second",
        {title: on_the_floor(robot) for robot, title in STANDING.items()},
    ),
    "one_core.svg": Bars(
        "Forward dynamics of a sample of a batch on one core, f64",
        "microseconds",
        {
            NAMES[robot]: {
                "rbjax": f"cpu.forward.{robot}",
                "Pinocchio": f"cpu.forward.{robot}.pinocchio",
            }
            for robot in ("panda", "g1")
        },
    ),
    "one_call.svg": Bars(
        "One call of forward dynamics from Python on one core, f64",
        "microseconds",
        {
            title: {
                "rb.compile": f"cpu.call.{robot}",
                "mj_forward": f"cpu.call.{robot}.mujoco",
                "jax.jit": f"cpu.call.{robot}.jit",
            }
            for robot, title in NAMES.items()
        },
    ),
    "compile.svg": Bars(
        "Compiling forward dynamics on a CPU",
        "seconds",
        {
            title: {"rbjax": f"cpu.compile.{robot}", "MJX": f"cpu.compile.{robot}.mjx"}
            for robot, title in NAMES.items()
        },
    ),
    "accuracy.svg": Dots(
        "Error of forward dynamics in f32 on an H200, median of 100 states of each model",
        "relative error against f64",
        "gpu-accuracy-nvidia-h200",
        {"rbjax": "rbjax median", "MJX": "MJX median"},
    ),
}
