# Everything from a bare checkout: `make test` makes its own .venv first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
# processes of pytest; `make test-all JOBS=16` on a machine with 16 cores and 4 GB of memory for each
JOBS   ?= 2
# worksteal: a worker gets a half of the files in a row, so what a file's tests share is compiled once
PYTEST := $(BIN)/pytest -n $(JOBS) --dist worksteal
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Each process of the tests would compile every source once more.
unexport PYTHONDONTWRITEBYTECODE

# Tests and the demo compile the same programs again and again: keep them between runs.
# In quick tests XLA compiles without optimizations (tests/conftest.py); machine code is as for users.
# (Benchmarks measure compilation, so they do without.)
test test-all demo: export JAX_COMPILATION_CACHE_DIR := $(CURDIR)/.cache/jax
test test-all demo: export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS := 0.5

.PHONY: help setup test quick test-gpu test-all test-oldest test-nightly test-envs test-wheel lint types demo bench failure-map wheel-contact bench-work-precision notebooks docs clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-20s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## make .venv with rbjax (editable) and everything the tests need

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "rbjax needs Python 3.11 or newer, and $(PYTHON) is '$$($(PYTHON) --version 2>&1)':" \
	       "name a newer one, as in 'make setup PYTHON=python3.12'." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "$(PYTHON) cannot make a virtual environment: on Debian, 'apt install python3-venv'." >&2; \
	  exit 1; }
	@echo "installing rbjax and its test tools into $(VENV), a minute or two ..."
	@$(BIN)/pip install -qq --no-compile --editable '.[test]'  # Python compiles what is imported
	@touch $@

test: $(STAMP) ## lint, types, tests, doctests, notebooks; not the slow ones
	@$(MAKE) --no-print-directory --jobs 3 lint types quick

quick: $(STAMP)
	$(PYTEST) -m "not slow"

test-gpu: $(STAMP) ## on an NVIDIA GPU: the threads compiler's tests as kernels, beside XLA's CPU
	JAX_PLATFORMS=cpu,cuda $(PYTEST) -m "not slow" tests/compiler tests/motion/test_checkpointed_rollout.py tests/dynamics/test_limbs.py

test-all: lint types ## the same with the slow tests; JOBS=16 on many cores; a summary in .cache/test-all.xml
	$(PYTEST) --durations=20 --junitxml=.cache/test-all.xml

# Old packages warn of the parts of newer ones that they use.
test-oldest: ## the quick tests with the oldest versions that pyproject.toml accepts, in .venv-oldest
	$(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python tests/oldest.py > .venv-oldest/constraints.txt
	.venv-oldest/bin/pip install -qq --editable '.[test]' --constraint .venv-oldest/constraints.txt
	.venv-oldest/bin/pytest -n $(JOBS) --dist worksteal -m "not slow" -W ignore::DeprecationWarning

JAX_NIGHTLY := https://us-python.pkg.dev/ml-oss-artifacts-published/jax/simple/
test-nightly: ## the quick tests with the nightly build of JAX, in .venv-nightly
	$(PYTHON) -m venv .venv-nightly
	.venv-nightly/bin/pip install -qq --editable '.[test]'
	.venv-nightly/bin/pip install -qq --upgrade --pre jax jaxlib --extra-index-url $(JAX_NIGHTLY)
	.venv-nightly/bin/pytest -n $(JOBS) --dist worksteal -m "not slow" -W ignore::DeprecationWarning

test-wheel: $(STAMP) ## build the wheel, install it into an empty environment, run the first example
	$(BIN)/pytest -s tests/package/test_wheel.py

# PyTorch for Linux brings CUDA, several GB.
test-envs: ## the adapters to learning libraries with all of them, rsl-rl and PyTorch too, in .venv-envs
	$(PYTHON) -m venv .venv-envs
	.venv-envs/bin/pip install -qq --editable '.[test,envs,rsl]'
	.venv-envs/bin/pytest -n $(JOBS) tests/envs/adapters rbjax/envs/adapters

lint: $(STAMP) ## ruff
	$(BIN)/ruff check --quiet .
	$(BIN)/ruff format --check --quiet rbjax tests

types: $(STAMP) ## mypy
	$(BIN)/mypy

demo: $(STAMP) ## the main job on bundled scenes; pictures and a report in ./rbjax-demo/
	$(BIN)/rbjax demo

# gpu/ wants an NVIDIA GPU and is left out where there is none
BENCHES = $(subst /,.,$(basename $(wildcard benchmarks/cpu/*.py) benchmarks/accuracy/against_mujoco.py \
  $(if $(shell command -v nvidia-smi),benchmarks/gpu/mjx.py benchmarks/gpu/threads.py)))

bench: $(STAMP) ## every benchmark, an hour; results by device in benchmarks/results/; names those that failed
	@failed=""; \
	for script in $(BENCHES); do \
	  echo "$$script"; begin=$$(date +%s); $(BIN)/python -m $$script || failed="$$failed $$script"; \
	  echo "$$script: $$(($$(date +%s) - begin)) s"; \
	done; \
	if [ -n "$$failed" ]; then echo "failed:$$failed"; exit 1; fi

failure-map: $(STAMP) ## every solver on scenes built to break it; docs/benchmarks/figures/failure_map.png
	$(BIN)/python -m benchmarks.maps.failure_map

wheel-contact: $(STAMP) ## rolling wheels compared with slipping ones and MuJoCo, 15 minutes; docs/guides/figures/wheel_contact.png
	$(BIN)/python -m benchmarks.accuracy.wheel_contact

bench-work-precision: $(STAMP) ## error against time, here, hours; tables, and pictures in docs/
	$(BIN)/python -m benchmarks.work.precision
	$(BIN)/python -m benchmarks.work.queue
	$(BIN)/python -m benchmarks.work.stiffness
	$(BIN)/python -m benchmarks.work.formulations
	$(BIN)/python -m benchmarks.work.precision_chart

notebooks: $(patsubst %.py,%.ipynb,$(wildcard notebooks/*.py)) ## execute every notebook anew

# Executed aside and moved into place, so that a failure leaves the last good one.
notebooks/%.ipynb: notebooks/%.py $(STAMP) FORCE
	@mkdir -p .cache/notebooks
	$(BIN)/jupytext --quiet --to ipynb --set-kernel python3 --output .cache/$@ $<
	$(BIN)/jupyter-execute --inplace .cache/$@
	@mv .cache/$@ $@

FORCE:

docs: $(VENV)/.docs ## the documentation, into site/; fails on a dead link
	$(BIN)/python -m docs.generate
	$(BIN)/python -m zensical build --clean --strict --config-file .cache/mkdocs.yml
	$(BIN)/python -m docs.generate.check .cache/site
	@rm -rf site && cp -r .cache/site site

$(VENV)/.docs: $(STAMP)
	@$(BIN)/pip install -qq --no-compile --editable '.[docs]'
	@touch $@

clean: ## remove all that make has made, .venv included
	rm -rf $(VENV) .venv-oldest .venv-nightly .venv-envs .cache .mypy_cache .pytest_cache .ruff_cache build dist site *.egg-info rbjax-demo
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
