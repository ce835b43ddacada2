"""Adapters: an environment for the learning libraries, each in the interface of the library.

Files:
    brax.py: `to_brax` and `wrap_brax`, for Brax's PPO, SAC and APG.
    gymnax.py: `to_gymnax` and `to_rejax`.
    gymnasium.py: `to_gymnasium`, `to_gymnasium_vector`, `to_gymnasium_functional`.
    gymnasium_names.py: `register_gymnasium`, names for `gymnasium.make`.
    rsl_rl.py: `to_rsl_rl`, with PyTorch tensors that share memory with JAX.
    arguments.py: checks of arguments.
"""

from rbjax.envs.adapters.brax import to_brax, wrap_brax
from rbjax.envs.adapters.gymnasium import (
    to_gymnasium,
    to_gymnasium_functional,
    to_gymnasium_vector,
)
from rbjax.envs.adapters.gymnasium_names import register_gymnasium
from rbjax.envs.adapters.gymnax import GymnaxParams, to_gymnax, to_rejax
from rbjax.envs.adapters.rsl_rl import to_rsl_rl

__all__ = [
    "GymnaxParams",
    "register_gymnasium",
    "to_brax",
    "to_gymnasium",
    "to_gymnasium_functional",
    "to_gymnasium_vector",
    "to_gymnax",
    "to_rejax",
    "to_rsl_rl",
    "wrap_brax",
]

__dir__ = __all__.copy
