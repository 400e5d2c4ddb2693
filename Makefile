# A newcomer needs `make run` and `make test`; both first install .venv from requirements.lock.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Benchmarks whose report is stored in results/performance, for docs/performance.md and docs/scaling.md.
BENCHMARKS := compile_time compiling environment episodes estimator growth inference methods peers scaling seeds streaming sweep \
  training training_peers utilisation
# Benchmarks of an accelerator, and the folder of their reports.
GPU_BENCHMARKS := environment training methods estimator episodes
GPU_RESULTS := results/performance/gpu
VERSION = $(shell sed -n 's/^version = "\(.*\)"$$/\1/p' pyproject.toml)
# Version of the topmost section of the changelog.
CHANGES = $(shell sed -n 's/^\#\# \[\([^]]*\)\].*/\1/p' CHANGELOG.md | head -n 1)

.PHONY: help setup run test lint docs test-slow test-exhaustive coverage mutants gate regression versions bench bench-gpu package release lock clean

help:
	@echo 'make run        train on generated rooms, then evaluate the run (runs/rooms)'
	@echo 'make test       linter, import layers, types, documentation and the fast tests'
	@echo 'make test-slow  the slow tests'
	@echo 'make test-exhaustive  every method, world and environment of the slow tests; takes more than an hour'
	@echo 'make coverage   the fast tests, with the branch coverage of the package'
	@echo 'make mutants    change the code in many ways, and list the changes that no test detects'
	@echo 'make gate       fail if commands, training or environment are slower than at a stored commit, or need more memory'
	@echo 'make regression  train every method for a short time, and fail where success leaves its stored band'
	@echo 'make versions   the fast tests on every Python, with the oldest and the newest packages'
	@echo 'make docs       build the documentation, site/index.html'
	@echo 'make bench      run the benchmarks of speed, and update results/performance and the tables of the documentation'
	@echo 'make bench-gpu  the benchmarks of docs/gpu.md on a GPU, into results/performance/gpu'
	@echo 'make package    build the wheel and the source archive in dist/, and try the wheel in a new environment'
	@echo 'make release    make package for a committed version with a changelog; uploads and tags nothing'
	@echo 'make setup      only install .venv;  make lock  pin newer versions;  make clean  remove what was built'

setup: $(READY)

# The stamp is written last, so an interrupted or failed installation starts again with an empty .venv.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "jaxnav needs Python 3.11 or newer; '$(PYTHON)' is not: try 'make $(or $(MAKECMDGOALS),setup) PYTHON=python3.11'" >&2; \
	  exit 1; }
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

run: $(READY)
	$(BIN)/python train.py --run-dir runs/rooms
	$(BIN)/python eval.py runs/rooms

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright --threads 2 --pythonpath $(BIN)/python

# Every warning, such as a broken link, is an error, but mkdocs does not count warnings that `--quiet` hides.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

test: lint docs
	$(BIN)/python -m pytest -n 2

test-slow: $(READY)
	$(BIN)/python -m pytest -n 2 -m "slow and not exhaustive" --timeout 900 --durations 20

test-exhaustive: $(READY)
	$(BIN)/python -m pytest -n 2 -m exhaustive --timeout 1800 --durations 20

coverage: $(READY)
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term:skip-covered

mutants: $(READY)
	cd tests && PYTHONPATH=.. ../$(BIN)/python -m support.planted && PYTHONPATH=.. ../$(BIN)/python -m support.mutants

# COMMIT is the one that results/performance/gate_commit.txt names.
COMMIT :=

gate: $(READY)
	$(BIN)/python benchmarks/gate.py $(COMMIT)

# METHODS are all unless some are named.
METHODS :=

regression: $(READY)
	$(BIN)/python benchmarks/regression.py $(METHODS)

# Needs uv, which downloads each Python.
PYTHONS := 3.11 3.12 3.13
RESOLUTIONS := lowest-direct highest
TESTS :=

versions:
	@failed=; for python in $(PYTHONS); do for resolution in $(RESOLUTIONS); do \
	  name=$$python-$$resolution; venv=.cache/versions/$$name; echo "== $$name"; \
	  uv venv --quiet --clear --python $$python $$venv && \
	  uv pip install --quiet --python $$venv --resolution $$resolution --editable . --group dev && \
	  $$venv/bin/python -m pytest -n 2 $(TESTS) || failed="$$failed $$name"; \
	done; done; test -z "$$failed" || { echo "failed:$$failed" >&2; exit 1; }

# Runs the benchmarks $(1) into the folder $(2), then the command $(3). A benchmark that fails keeps its last result,
# and the other benchmarks still run.
define run_benchmarks
@mkdir -p $(2); failed=; for name in $(1); do \
  echo "== $$name"; result=$(2)/$$name.json; \
  if $(BIN)/python benchmarks/$$name.py > $$result.new; then mv $$result.new $$result; \
  else rm -f $$result.new; failed="$$failed $$name"; fi; done; \
$(3) || exit 1; \
test -z "$$failed" || { echo "failed:$$failed" >&2; exit 1; }
endef

bench: $(READY)
	$(call run_benchmarks,$(BENCHMARKS),results/performance,$(BIN)/python benchmarks/table.py && $(BIN)/python benchmarks/simulate.py)

# Needs JAX for CUDA in .venv, see docs/gpu.md. Without full precision a GPU rounds the factors of matrix products.
bench-gpu: export JAX_DEFAULT_MATMUL_PRECISION := highest
bench-gpu: $(READY)
	$(call run_benchmarks,$(GPU_BENCHMARKS),$(GPU_RESULTS),true)

# Builds the source archive, and the wheel from it. The wheel is tried where there are no sources.
TRIAL := .cache/release
JAXNAV = ../bin/jaxnav

package: $(READY)
	rm -rf build dist *.egg-info $(TRIAL)
	$(BIN)/python -m build --no-isolation --quiet
	$(BIN)/twine check --strict dist/*
	$(BIN)/python -m venv $(TRIAL)
	$(TRIAL)/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	mkdir $(TRIAL)/smoke
	cd $(TRIAL)/smoke && $(JAXNAV) --version | grep -Fx 'jaxnav $(VERSION)' && $(JAXNAV) list && \
	  $(JAXNAV) train --config smoke --total-steps 61_440 --run-dir run && $(JAXNAV) eval run --episodes 40

# Needs a committed version with a section of the changelog. CONTRIBUTING.md lists the commands that publish it.
release: $(READY)
	@test -z "$$(git status --porcelain)" || { echo 'release: there are uncommitted changes; commit them' >&2; exit 1; }
	@test '$(VERSION)' = '$(CHANGES)' || { \
	  echo 'release: pyproject.toml has version $(VERSION), but CHANGELOG.md begins with $(CHANGES)' >&2; exit 1; }
	@$(MAKE) --no-print-directory package
	@echo 'jaxnav $(VERSION) is ready in dist/; CONTRIBUTING.md lists the commands that publish it'

# For maintainers; needs uv.
lock:
	uv pip compile pyproject.toml --group dev --universal --python-version 3.11 --fork-strategy fewest \
	  --upgrade --no-header --no-annotate --generate-hashes --quiet --output-file requirements.lock

clean:
	rm -rf .venv build dist site *.egg-info .cache .hypothesis .import_linter_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
