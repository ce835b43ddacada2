"""The wheel: its files, and an installation into an empty environment."""

import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rbjax.demo.notebooks import NOTEBOOKS

ROOT = Path(__file__).parents[2]
BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
MEGABYTES, SECONDS, IMPORT = 3.0, 60.0, 1.0  # what the wheel may take


def test_notebooks_of_the_demo_are_in_the_wheel() -> None:
    files = {f"notebooks/{name}.py": f"rbjax/demo/scripts/{name}.py" for name in NOTEBOOKS}
    assert BUILD["targets"]["wheel"]["force-include"] == files
    assert all((ROOT / file).is_file() for file in files)


@pytest.fixture(scope="module")
def wheel() -> Iterator[Path]:
    pytest.importorskip("build", reason="the package build is not installed: make setup")
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "build", "--outdir", folder, str(ROOT)]
        made = subprocess.run(command, capture_output=True, text=True)
        if "No matching distribution found for hatchling" in made.stdout + made.stderr:
            pytest.skip("no network")
        assert made.returncode == 0, made.stdout + made.stderr
        (path,) = Path(folder).glob("*.whl")
        assert len([*Path(folder).glob("*.tar.gz")]) == 1
        yield path


@pytest.mark.slow
def test_files_of_the_wheel(wheel: Path) -> None:
    files = {x for x in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in x}
    listed = subprocess.run(["git", "ls-files", "rbjax"], capture_output=True, text=True, cwd=ROOT)
    if listed.returncode == 0 and listed.stdout:
        ours = {*listed.stdout.split()} - {x for x in listed.stdout.split() if "/." in x}
        assert files == ours | {f"rbjax/demo/scripts/{name}.py" for name in NOTEBOOKS}
    assert {Path(x).suffix for x in files} == {".py", ".xml", ".html", ".js", ".typed"}
    assert wheel.stat().st_size < MEGABYTES * 1e6


def first_example() -> tuple[str, str]:
    """The first Python block of the README, and the output that follows it."""
    text = (ROOT / "README.md").read_text()
    found = re.search(r"```python\n(.*?)```\s*```text\n(.*?)```", text, re.DOTALL)
    assert found
    return found[1], found[2]


def test_cuda_of_jax_is_named_once() -> None:
    """Its version changes from time to time: pyproject.toml and one page have it."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    files = [*pages, *(ROOT / "rbjax").rglob("*.py"), *(ROOT / "notebooks").glob("*.py")]
    found = [x for x in files if "cuda13]" in x.read_text() and x.name != "CHANGELOG.md"]
    assert found == [ROOT / "docs" / "start" / "install.md"]


CODE = """
import time
import jax, jax.numpy
begin = time.process_time()
import rbjax
print(time.process_time() - begin)
assert "site-packages" in rbjax.__file__
"""


@pytest.mark.slow
def test_it_runs_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = Path(folder) / ("Scripts" if os.name == "nt" else "bin") / "python"
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        environment |= {"JAX_PLATFORMS": "cpu"}

        def run(*arguments: str) -> subprocess.CompletedProcess[str]:
            return subprocess.run(
                [str(python), *arguments], capture_output=True, text=True, cwd=tmp_path,
                env=environment,
            )  # fmt: skip

        begin = time.perf_counter()
        installed = run("-m", "pip", "install", "-q", "--no-compile", str(wheel))
        seconds = time.perf_counter() - begin
        assert installed.returncode == 0, installed.stderr
        run("-c", "import rbjax")  # Python compiles what is imported
        code, output = first_example()
        example = run("-c", code)
        assert example.returncode == 0, example.stderr
        assert example.stdout == output
        # CPU seconds, the least of three: other processes may run
        imports = [run("-c", CODE) for _ in range(3)]
        assert not imports[0].returncode, imports[0].stderr
        over_jax = min(float(x.stdout) for x in imports)
        help_ = run("-m", "rbjax")
        assert (help_.returncode, help_.stderr.count("\n")) == (2, 1)
        assert "pip install 'rbjax[cli]'" in help_.stderr
        print(f"{wheel.stat().st_size / 1e6:.2f} MB, installed in {seconds:.0f} s, "
              f"import {over_jax:.2f} CPU seconds over jax")  # fmt: skip
        assert seconds < SECONDS and over_jax < IMPORT
