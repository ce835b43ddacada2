"""Settings of trainings, by task and algorithm.

The settings of PPO for Go1, G1, Panda, cart-pole, hopper and walker are those of MuJoCo Playground
0.2 (Zakka et al. 2025, `config/locomotion_params.py`, `manipulation_params.py`,
`dm_control_suite_params.py`).
Those of a CPU and of SHAC are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax

from rbjax.arguments import choice
from rbjax.envs.registry import tasks

ALGORITHMS = ("ppo", "shac")

#: PPO: arguments of `rbjax.envs.learning.ppo`
PPO: dict[str, Any] = {
    "steps": 20_000_000, "num_envs": 2048, "unroll_length": 20, "batch_size": 256,
    "num_minibatches": 32, "num_updates_per_batch": 4, "discounting": 0.97, "learning_rate": 3e-4,
    "entropy_cost": 1e-2, "reward_scaling": 1.0, "max_grad_norm": 1.0, "reports": 10,
    "policy_hidden": (128, 128, 128), "value_hidden": (256, 256, 256),
}  # fmt: skip
CONTROL_SUITE = {
    "steps": 60_000_000, "num_envs": 2048, "unroll_length": 30, "batch_size": 1024,
    "num_minibatches": 32, "num_updates_per_batch": 16, "discounting": 0.995,
    "learning_rate": 1e-3, "entropy_cost": 1e-2, "reward_scaling": 10.0, "max_grad_norm": None,
    "policy_hidden": (32,) * 4, "value_hidden": (256,) * 5,
}  # fmt: skip
#: three seeds swing the cart-pole up (a return of 800) after 6.1 million steps
SWING_UP_PPO = CONTROL_SUITE | {
    "steps": 20_000_000, "num_envs": 512, "batch_size": 256, "entropy_cost": 3e-2,
    "reward_scaling": 1.0, "policy_hidden": (32, 32), "value_hidden": (128, 128, 128),
}  # fmt: skip
GO1 = {
    "steps": 200_000_000, "num_envs": 8192, "unroll_length": 20, "batch_size": 256,
    "num_minibatches": 32, "num_updates_per_batch": 4, "discounting": 0.97, "learning_rate": 3e-4,
    "entropy_cost": 1e-2, "max_grad_norm": 1.0, "reports": 10,
    "policy_hidden": (512, 256, 128), "value_hidden": (512, 256, 128),
}  # fmt: skip
G1 = GO1 | {"entropy_cost": 5e-3, "clipping_epsilon": 0.2, "reports": 20}
PANDA = {
    "steps": 20_000_000, "num_envs": 2048, "unroll_length": 10, "batch_size": 512,
    "num_minibatches": 32, "num_updates_per_batch": 8, "discounting": 0.97, "learning_rate": 1e-3,
    "entropy_cost": 2e-2, "max_grad_norm": None, "reports": 8,
    "policy_hidden": (32,) * 4, "value_hidden": (32,) * 4,
}  # fmt: skip
#: for a core of a CPU: small networks and few samples
FEW: dict[str, Any] = {
    "steps": 600_000, "num_envs": 64, "unroll_length": 16, "batch_size": 64,
    "num_minibatches": 4, "num_updates_per_batch": 16, "reports": 3, "policy_hidden": (32, 32),
    "value_hidden": (64, 64),
}  # fmt: skip
#: nine seeds balance the cart-pole (a return of 800) after 230,000 to 570,000 steps
CPU_PPO = FEW | {
    "steps": 800_000, "batch_size": 32, "num_minibatches": 16, "num_updates_per_batch": 8,
    "discounting": 0.98, "learning_rate": 3e-3, "entropy_cost": 1e-2, "reward_scaling": 10.0,
    "max_grad_norm": 1.0,
}  # fmt: skip
CPU_BATCH = 128  # of SHAC

#: SHAC: arguments of `rbjax.envs.learning.shac`; steps = iterations * batch * horizon
SHAC: dict[str, Any] = {
    "steps": 2_000_000, "batch": 256, "horizon": 32, "discount": 0.99, "td_lambda": 0.95,
    "rate": 2e-3, "critic_rate": 2e-3, "critic_steps": 16, "hidden": (128, 64), "reports": 20,
}  # fmt: skip
CART_POLE_SHAC = {
    "steps": 1_000_000, "batch": 128, "horizon": 16, "rate": 1e-2, "discount": 0.98, "std": 0.2,
    "hidden": (32, 16),
}  # fmt: skip
#: three seeds swing the cart-pole up after 640,000 steps
SWING_UP_SHAC = CART_POLE_SHAC | {"rate": 2e-2}
GO1_SMOOTH_SHAC = {
    "steps": 3_000_000, "batch": 64, "rate": 2e-3, "critic_rate": 1e-3, "target_rate": 0.8,
    "std": 0.37, "hidden": (128, 64, 32),
}  # fmt: skip
#: of the hopper of Xu et al. 2022, whose policy network, its rate and `target_rate` these are
HOPPER_RUN_SHAC = {
    "steps": 2_000_000, "batch": 64, "rate": 2e-3, "critic_rate": 1e-3, "target_rate": 0.8,
    "std": 0.37, "hidden": (128, 64, 32),
}  # fmt: skip
HOPPER_RUN_PPO = CONTROL_SUITE | {
    "num_updates_per_batch": 8, "discounting": 0.99, "learning_rate": 3e-4, "entropy_cost": 1e-3,
    "reward_scaling": 0.1, "max_grad_norm": 1.0, "policy_hidden": (128, 64, 32),
}  # fmt: skip
LEGS_SHAC = {
    "steps": 8_000_000, "batch": 256, "horizon": 32, "discount": 0.98, "rate": 1e-3,
    "critic_rate": 1e-3, "target_rate": 0.5, "std": 0.3, "max_grad_norm": 0.02,
}  # fmt: skip

TASKS: dict[str, dict[str, Mapping[str, Any]]] = {
    "cart_pole_balance": {"ppo": CONTROL_SUITE, "ppo cpu": CPU_PPO, "shac": CART_POLE_SHAC},
    "cart_pole_swing_up": {"ppo": SWING_UP_PPO, "ppo cpu": CPU_PPO, "shac": SWING_UP_SHAC},
    "go1_joystick_flat": {"ppo": GO1, "shac": LEGS_SHAC},
    "go1_joystick_rough": {"ppo": GO1, "shac": LEGS_SHAC},
    "go1_joystick_smooth": {"ppo": GO1, "shac": GO1_SMOOTH_SHAC, "shac cpu": {}},
    "g1_joystick": {"ppo": G1, "shac": LEGS_SHAC},
    "panda_pick_cube": {"ppo": PANDA},
    **{f"hopper_{name}": {"ppo": CONTROL_SUITE, "shac": LEGS_SHAC} for name in ("stand", "hop")},
    "hopper_run": {
        "ppo": HOPPER_RUN_PPO,
        "shac": HOPPER_RUN_SHAC,
        "shac cpu": {"steps": 600_000},
    },
    **{
        f"walker_{name}": {"ppo": CONTROL_SUITE, "shac": LEGS_SHAC}
        for name in ("stand", "walk", "run")
    },
}


def settings(
    task: str | None, algorithm: str = "ppo", backend: str | None = None
) -> dict[str, Any]:
    """Return the settings of a training.

    Args:
        task: name of a task; None for the general settings, which a task without settings of its
            own has, too.
        algorithm: "ppo" or "shac".
        backend: "cpu", "gpu"; None for the present one. A CPU has few samples: 64 at a time in PPO,
            128 in SHAC, 64 for `go1_joystick_smooth` and `hopper_run`. PPO of a legged robot only
            shows there that it runs.

    Returns:
        Arguments of `ppo` or of `shac`, and "steps", the steps of the robot in the training.

    Raises:
        UnknownName: no such task or algorithm.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.learning.settings("go1_joystick_flat", backend="gpu")["num_envs"]
        8192
    """
    choice("algorithm", algorithm, ALGORITHMS)
    if task is not None:
        choice("task", task, tasks())
    if backend is not None:
        choice("backend", backend, ("cpu", "gpu", "tpu"))
    backend = jax.default_backend() if backend is None else backend
    own = TASKS.get(task, {}) if task is not None else {}
    found = (PPO if algorithm == "ppo" else SHAC) | dict(own.get(algorithm, {}))
    if backend != "cpu":
        return found
    if algorithm == "ppo":
        return found | dict(own.get("ppo cpu", FEW if "ppo" in own else CPU_PPO))
    if "shac cpu" in own:
        return found | dict(own["shac cpu"])
    steps = found["steps"] * CPU_BATCH // found["batch"]  # as many iterations
    return found | {"batch": CPU_BATCH, "steps": steps}
