# Everything a newcomer needs is `make run` and `make test`; both set up .venv from requirements.lock first.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
BENCHMARKS := $(filter-out benchmarks/_%,$(wildcard benchmarks/*.py))

.PHONY: help setup run test lint test-slow bench lock clean

help:
	@echo 'make run        train on procedural rooms, then evaluate the run (runs/rooms)'
	@echo 'make test       lint, import layers, types and the fast tests'
	@echo 'make test-slow  the slow tests'
	@echo 'make bench      every benchmark in benchmarks/'
	@echo 'make setup      only build .venv;  make lock  pin anew;  make clean  remove what was built'

setup: $(READY)

# The stamp is written last: an interrupted or failed set-up starts over from an empty .venv.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "jaxnav needs Python 3.11 or newer; '$(PYTHON)' is not: try 'make $(or $(MAKECMDGOALS),setup) PYTHON=python3.11'" >&2; \
	  exit 1; }
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

run: $(READY)
	$(BIN)/python train.py --run-dir runs/rooms
	$(BIN)/python eval.py runs/rooms

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright --pythonpath $(BIN)/python

test: lint
	$(BIN)/python -m pytest

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow

bench: $(READY)
	@set -e; for file in $(BENCHMARKS); do echo "== $$file"; $(BIN)/python $$file; done

# For maintainers, and the one target that needs uv.
lock:
	uv pip compile pyproject.toml --group dev --universal --python-version 3.11 --fork-strategy fewest \
	  --upgrade --no-header --no-annotate --generate-hashes --quiet --output-file requirements.lock

clean:
	rm -rf .venv build *.egg-info .cache .hypothesis .import_linter_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
