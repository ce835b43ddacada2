"""The programs of docs/guides/adapters.md run, with smaller numbers."""

import re
from pathlib import Path

import jax
import pytest

PAGE = Path(__file__).parents[3] / "docs/guides/adapters.md"
SECTIONS = dict(re.findall(r"## ([^\n]+)\n\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
SMALLER = {
    "episode_length": 20, "num_timesteps": 1000, "num_envs": 8, "unroll_length": 5, "batch_size": 8,
    "num_minibatches": 2, "num_updates_per_batch": 1, "num_evals": 2, "num_steps": 8,
    "total_timesteps": 200, "eval_freq": 100,
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.parametrize(
    "section, package",
    [("Brax", "brax"), ("rejax and gymnax", "rejax"), ("Gymnasium", "gymnasium"),
     ("rsl-rl", "rsl_rl")],
)  # fmt: skip
def test_programs_run(section, package, tmp_path, monkeypatch):
    pytest.importorskip(package, reason="pip install 'rbjax[envs,rsl]', or make test-envs")
    monkeypatch.chdir(tmp_path)
    program = SECTIONS[section].replace("runner.learn(300", "runner.learn(2")
    for name, number in SMALLER.items():
        program = re.sub(rf"\b{name}=[\d_]+", f"{name}={number}", program)
    with jax.enable_x64(False):
        exec(compile(program, f"{PAGE.name}, {section}", "exec"), {})
