# Two commands matter: `make demo` and `make test`. Both make .venv first, if it is not there.
# `make test-fast` runs the tests that take less than about a second each.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# A worker per core: torch's own threads would only get in each other's way.
TEST_ENV := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 NPDR_NUM_THREADS=1

.PHONY: demo test test-fast style types docs dist bench clean

$(VENV)/installed: pyproject.toml constraints.txt
	@echo "==> making $(VENV) with $$($(PYTHON) --version)"
	$(PYTHON) -m venv $(VENV)
	@echo "==> installing torch, then everything else with constraints.txt (a few minutes)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	@touch $@

demo: $(VENV)/installed
	@echo "==> training a policy for a Furuta pendulum made by MuJoCo; figures go to demo-output/"
	$(BIN)/npdr demo --out demo-output

test: style
	@echo "==> tests on $(WORKERS) workers"
	$(TEST_ENV) $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations=15

test-fast: style
	@echo "==> quick tests on $(WORKERS) workers"
	$(TEST_ENV) $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not slow" --quiet

style: $(VENV)/installed
	@echo "==> style and layers"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

# The type checker is a Node program that fetches itself, so `make test` does without it.
types: $(VENV)/installed
	@echo "==> types"
	$(BIN)/pyright

docs: $(VENV)/installed
	@echo "==> documentation, in build/site"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[docs]"
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going docs build/site

# Built from what is committed, so that no file of the checkout slips in.
dist: $(VENV)/installed
	@echo "==> source distribution and wheel, in dist/"
	@git diff --quiet HEAD || { echo "The checkout has changes. Commit them first."; exit 2; }
	rm -rf dist build/source && mkdir -p build/source
	git archive HEAD | tar -x -C build/source
	$(BIN)/python -m build --outdir dist build/source

bench: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev,bench]"
	$(BIN)/python benchmarks/simulation.py
	$(BIN)/python benchmarks/inference.py

clean:
	rm -rf $(VENV) build dist demo-output *.egg-info
