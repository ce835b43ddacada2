"""Tasks on a GPU, and training."""

from __future__ import annotations

from docs.generate import measured
from docs.generate.figures.kinds import Figure, Number, Ratio

H100, H200, CPU = "nvidia-h100-80gb-hbm3", "nvidia-h200", "amd-epyc"


def _rate(task: str, what: str = "step") -> Number:
    """Millions of control steps a second of 8,192 robots."""
    where = {"task": task, "what": what, "batch": 8192}
    device = H100 if what == "unroll" else H200
    return Number(f"gpu-environments-{device}", "M/s", where, digits=2)


def _share(task: str) -> Ratio:
    """The rate of control steps over that of `rb.rollout`."""
    return Ratio(_rate(task), _rate(task, "rollout"), 2)


def _swing_up(algorithm: str, column: str = "steps") -> Number:
    """The steps or seconds of a training until the reward of an episode is 800."""

    def first(row: measured.Row) -> float:
        return min(report[column] for report in row["curve"] if report["reward"] >= 800)

    return Number(f"training-cart-pole-swing-up-{algorithm}-{H200}", first, digits=2)


def _trained(task: str, algorithm: str, device: str, column: str = "return") -> Number:
    """A column of a training or of the evaluation after it. "steps" is in millions."""
    file = f"training-{task}-{algorithm}-{device}"
    if column != "return":
        return Number(file, column, scale=1e-6 if column == "steps" else 1.0)
    return Number(file, lambda row: measured.evaluation(row)["return"])


def _gait(legs: str) -> Number:
    """The correlation of the thighs of these legs of a Go1 that walks forward."""
    return Number("gait-go1-joystick-smooth-amd-epyc", legs, {"command": "forward"}, digits=2)


def _policy(task: str, trained: str, physics: str, options: str = "") -> Number:
    """The return of a saved policy."""
    where = {"task": task, "trained_with": trained, "physics": physics, "options": options}
    return Number("policies-amd-epyc", "return", where)


RANDOMISED = "iterations=3, randomise=True"
FIGURES: dict[str, Figure] = {
    "envs.go1": _rate("go1_joystick_flat"),
    "envs.g1": _rate("g1_joystick"),
    "envs.panda": _rate("panda_pick_cube"),
    "envs.cart-pole": _rate("cart_pole_balance"),
    "envs.cart-pole.unrolled": _rate("cart_pole_balance", "unroll"),
    "envs.go1.one": _rate("go1_joystick_flat:iterations=1"),
    "envs.g1.three": _rate("g1_joystick:iterations=3"),
    "envs.panda.physics": Number(
        f"gpu-environments-{H200}",
        "physics M/s",
        {"task": "panda_pick_cube", "what": "rollout", "batch": 8192},
        digits=2,
    ),
    "envs.go1.share": _share("go1_joystick_flat"),
    "envs.g1.share": _share("g1_joystick"),
    "envs.panda.share": _share("panda_pick_cube"),
    "training.steps-ratio": Ratio(_swing_up("ppo"), _swing_up("shac"), 2),
    "training.swing-up.ppo.seconds": _swing_up("ppo", "seconds"),
    "training.swing-up.shac.seconds": _swing_up("shac", "seconds"),
    "training.balance.seconds": Number(
        f"training-cart-pole-balance-ppo-{CPU}", "goal_reached_s", digits=2
    ),
    "training.go1.ppo.seconds": _trained("go1-joystick-flat", "ppo", H100, "seconds"),
    "training.g1.ppo.seconds": _trained("g1-joystick", "ppo", H100, "seconds"),
    "training.panda.ppo.seconds": _trained("panda-pick-cube", "ppo", H200, "seconds"),
    "training.hopper.shac": _trained("hopper-run", "shac", H200),
    "training.hopper.shac.steps": _trained("hopper-run", "shac", H200, "steps"),
    "training.hopper.ppo": _trained("hopper-run", "ppo", H200),
    "training.hopper.ppo.steps": _trained("hopper-run", "ppo", H200, "steps"),
    "training.go1.shac": _trained("go1-joystick-smooth", "shac", CPU),
    "training.go1.shac.steps": _trained("go1-joystick-smooth", "shac", CPU, "steps"),
    "training.go1.shac.core-seconds": _trained("go1-joystick-smooth", "shac", CPU, "core_seconds"),
    "gait.diagonal": _gait("diagonal"),
    "gait.neighbours": _gait("neighbours"),
    "training.go1.ppo": _trained("go1-joystick-flat", "ppo", H100),
    "policy.go1": _policy("go1_joystick_flat", "", "rbjax"),
    "policy.go1.mujoco": _policy("go1_joystick_flat", "", "MuJoCo C"),
    "policy.g1": _policy("g1_joystick", RANDOMISED, "rbjax"),
    "policy.g1.mujoco": _policy("g1_joystick", RANDOMISED, "MuJoCo C"),
    "policy.g1.changed": _policy("g1_joystick", RANDOMISED, "rbjax", "randomise=True"),
    "policy.g1.plain.changed": _policy("g1_joystick", "iterations=3", "rbjax", "randomise=True"),
}
