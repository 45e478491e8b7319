# Everything runs in a virtual environment of its own; each target sets up what it needs.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
KERNELS := $(wildcard equirl/modules/native/*.[ch]pp)

.PHONY: setup demo test test-all lint format benchmark docs clean

setup: $(READY)

# uv honours the dependency override in pyproject.toml that spares a Fortran compiler.
$(READY): setup.py setup.cfg pyproject.toml constraints.txt $(KERNELS)
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) not found; equirl needs Python 3.11 (PyBullet has no newer wheels)"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python -c constraints.txt -e '.[dev,tracking,meshes,sb3,export,launchers,docs]'
	touch $@

# Trains on Block Picking from nothing to a report; interrupted, it goes on where it stopped.
demo: setup
	$(BIN)/python experiments/train.py preset=laptop output=outputs/demo

test: setup
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-all: setup $(VENV)/.ray
	$(BIN)/python -m pytest -n 2

# Ray is large, and only one test asks for the real one.
$(VENV)/.ray: $(READY)
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python -c constraints.txt -e '.[ray]'
	touch $@

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: setup
	$(BIN)/python experiments/benchmark.py

# The pages of docs/ and the reference of all public names: open site/index.html.
docs: setup
	$(BIN)/python docs/build_site.py

clean:
	rm -rf $(VENV) build site *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	rm -f equirl/modules/native/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
