"""The files of .github/workflows are valid, and call targets that the Makefile has."""

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def steps_of(job: dict[str, Any]) -> list[dict[str, str]]:
    """The steps of a job, for each entry of its matrix."""
    matrix = job.get("strategy", {}).get("matrix", {})
    targets = matrix.get("target", [""])
    return [
        {k: str(x).replace("${{ matrix.target }}", target) for k, x in step.items()}
        for step in job["steps"]
        for target in targets
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_targets_exist(path: Path) -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed: make setup")
    workflow = yaml.safe_load(path.read_text())
    targets = {*re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)}
    called = set()
    for job in workflow["jobs"].values():
        assert {"runs-on", "timeout-minutes", "steps"} <= job.keys()
        matrix = job.get("strategy", {}).get("matrix", {})
        assert {*re.findall(r"\$\{\{ *matrix\.(\w+) *\}\}", str(job))} == matrix.keys()
        for step in steps_of(job):
            assert ("run" in step) != ("uses" in step)
            assert step.keys() <= {"name", "run", "uses", "with", "if", "env"}
            assert re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step.get("uses", "a/b@v1"))
            shell = re.sub(r"\$\{\{.*?\}\}", "x", step.get("run", "true"))
            subprocess.run(["bash", "-n", "-c", shell], check=True)
            called |= {*re.findall(r"\bmake ([\w-]+)", step.get("run", ""))}
    assert called and called <= targets, called - targets
    assert True in workflow  # `on:` is true in YAML 1.1


def test_every_kind_of_test_is_run() -> None:
    text = "".join(path.read_text() for path in FILES)
    wanted = "test docs test-wheel test-all test-oldest test-nightly test-envs test-gpu"
    assert {x for x in wanted.split() if not re.search(rf"\b{x}\b", text)} == set()
    assert all(system in text for system in ("ubuntu-latest", "arm", "macos"))
