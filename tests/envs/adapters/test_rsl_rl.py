"""The rsl-rl adapter, with its runner. Without PyTorch (`rbjax[rsl]`, some hundred MB) it skips."""

import sys
from types import ModuleType

import jax
import numpy as np
import pytest

from rbjax.envs import adapters
from rbjax.errors import InputError
from tests.envs.adapters.small_task import environment

REASON = "needs PyTorch and rsl-rl: pip install 'rbjax[rsl]', or make test-envs"
try:
    import rsl_rl.env
    import torch
except ImportError:
    torch = None
needs_torch = pytest.mark.skipif(torch is None, reason=REASON)
THREADS = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")


@pytest.fixture(scope="module")
def env():
    return environment(episode=30)


@pytest.mark.parametrize("missing", ["torch", "tensordict", "rsl_rl"])
def test_a_missing_package_is_told(env, monkeypatch, missing):
    for name in ("torch", "tensordict", "rsl_rl"):
        monkeypatch.setitem(sys.modules, name, None if name == missing else ModuleType(name))
    with pytest.raises(InputError, match=r"pip install 'rbjax\[rsl\]'"):
        adapters.to_rsl_rl(env, 4)


@needs_torch
def test_a_step_is_that_of_the_environment(env):
    """Of the same keys, and nothing is copied: addresses are those of JAX's arrays."""
    batch = adapters.to_rsl_rl(env, 8)
    assert isinstance(batch, rsl_rl.env.VecEnv)
    state, key = batch.state, batch._key
    actions = torch.full((8, 1), 2.0, dtype=torch.float64)
    obs, reward, done, extras = batch.step(actions)
    keys = jax.random.split(jax.random.split(key)[1], 8)
    due = jax.vmap(env.step)(keys, state, np.full((8, 1), 2.0))
    np.testing.assert_array_equal(obs["policy"].numpy(), due[0])
    np.testing.assert_array_equal(reward.numpy(), due[2])
    np.testing.assert_array_equal(done.numpy(), due[3])
    np.testing.assert_array_equal(extras["time_outs"].numpy(), due[4]["truncated"])
    mean = due[4]["rewards"]["upright"].mean()
    np.testing.assert_allclose(extras["log"]["/reward/upright"].numpy(), mean, rtol=1e-12)
    assert batch.get_observations() is obs
    lengths = batch.episode_length_buf
    assert lengths.data_ptr() == batch.state.step.unsafe_buffer_pointer()
    array = jax.dlpack.from_dlpack(actions)  # 64 bytes aligned, as PyTorch allocates
    assert actions.data_ptr() == array.unsafe_buffer_pointer()


@needs_torch
def test_lengths_of_episodes_can_be_set(env):
    batch = adapters.to_rsl_rl(env, 4)
    batch.episode_length_buf = torch.tensor([0, 28, 29, 5])
    *_, extras = batch.step(torch.zeros(4, 1, dtype=torch.float64))
    assert extras["time_outs"].tolist() == [False, False, True, False]
    assert batch.episode_length_buf.tolist() == [1, 29, 0, 6]


@needs_torch
@THREADS
def test_the_runner_of_rsl_rl_learns_to_balance(tmp_path):
    from rsl_rl.runners import OnPolicyRunner

    with jax.enable_x64(False):  # rsl-rl computes in f32
        batch = adapters.to_rsl_rl(environment(critic=True, episode=100), 64)
        model = {
            "class_name": "MLPModel", "hidden_dims": [32, 32], "activation": "elu",
            "obs_normalization": True,
        }  # fmt: skip
        config = {
            "num_steps_per_env": 24, "save_interval": 1000,
            "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
            "actor": {
                **model,
                "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0},
            },
            "critic": model,
            "algorithm": {"class_name": "PPO", "learning_rate": 1e-3, "gamma": 0.98},
        }  # fmt: skip
        torch.manual_seed(0)
        torch.set_num_threads(1)  # small networks
        runner = OnPolicyRunner(batch, config, log_dir=str(tmp_path), device="cpu")
        runner.learn(1, init_at_random_ep_len=True)
        early = np.mean(runner.logger.lenbuffer)
        runner.learn(20)
        late = np.mean(runner.logger.lenbuffer)
    assert late > 2 * early
