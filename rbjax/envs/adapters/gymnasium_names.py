"""Names of the tasks in Gymnasium's registry: `gymnasium.make("rbjax/walker_walk-v0")`."""

from __future__ import annotations

from typing import Any

from rbjax.arguments import shown
from rbjax.envs.adapters.gymnasium import to_gymnasium, to_gymnasium_vector
from rbjax.envs.registry import make, tasks
from rbjax.errors import InputError
from rbjax.optional import require


def register_gymnasium() -> list[str]:
    """Register all tasks in Gymnasium: `gymnasium.make` and `gymnasium.make_vec` know them then.

    Use it with tools that take the name of an environment. Options of a task are options of
    `gymnasium.make`, and `autoreset` is one of `gymnasium.make_vec`. Tasks that are registered
    later by `rb.envs.register` need another call.

    Returns:
        The names, "rbjax/TASK-v0".

    Raises:
        InputError: Gymnasium is not installed.

    Source: Towers et al., *Gymnasium*, 2024.

    Example:
        >>> import gymnasium, rbjax as rb
        >>> names = rb.envs.adapters.register_gymnasium()
        >>> envs = gymnasium.make_vec("rbjax/cart_pole_balance-v0", num_envs=4)
        >>> envs.observation_space.shape
        (4, 5)
    """
    require("register_gymnasium", "gymnasium")
    import gymnasium

    names = []
    for task in tasks():
        name = f"rbjax/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make_one",
                vector_entry_point=f"{__name__}:make_batch",
                kwargs={"task": task},
            )
        names.append(name)
    return names


def make_one(task: str, render_mode: str | None = None, **options: Any) -> Any:
    """Make the `gymnasium.Env` of a task. `render_mode` is None: there is no picture."""
    _check_render_mode(render_mode)
    return to_gymnasium(make(task, **options))


def make_batch(
    task: str, num_envs: int, autoreset: str = "next_step", render_mode: str | None = None,
    **options: Any,
) -> Any:  # fmt: skip
    """Make the `gymnasium.vector.VectorEnv` of a task."""
    _check_render_mode(render_mode)
    return to_gymnasium_vector(make(task, **options), num_envs, autoreset=autoreset)


def _check_render_mode(mode: Any) -> None:
    if mode is not None:
        raise InputError(
            f"gymnasium.make: render_mode is {shown(mode)}, expected None; show episodes of a "
            "policy by `rbjax play`, or by rb.plotting"
        )
