# Everything a newcomer needs is `make run` and `make test`; both set up .venv from requirements.lock first.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Benchmarks whose report is stored in results/performance, for docs/performance.md and docs/scaling.md.
BENCHMARKS := compile_time compiling environment estimator growth inference methods peers scaling seeds streaming sweep \
  training training_peers utilisation

.PHONY: help setup run test lint docs test-slow coverage mutants gate versions bench lock clean

help:
	@echo 'make run        train on procedural rooms, then evaluate the run (runs/rooms)'
	@echo 'make test       lint, import layers, types and the fast tests'
	@echo 'make test-slow  the slow tests'
	@echo 'make coverage   the fast tests, and which branches of the package they take'
	@echo 'make mutants    planted mistakes and drawn mutants, which the tests have to notice'
	@echo 'make gate       fails where the environment is far slower than the stored result'
	@echo 'make versions   the fast tests on every Python, with the oldest and the newest packages'
	@echo 'make docs       the documentation as a site, in site/'
	@echo 'make bench      every benchmark into results/performance, then the tables of the documentation'
	@echo 'make setup      only build .venv;  make lock  pin anew;  make clean  remove what was built'

setup: $(READY)

# The stamp is written last: an interrupted or failed set-up starts over from an empty .venv.
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
	$(BIN)/pyright --pythonpath $(BIN)/python

# What is not as it should be, a broken link for one, is an error.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

test: lint docs
	$(BIN)/python -m pytest -n 2

test-slow: $(READY)
	$(BIN)/python -m pytest -n 2 -m slow --timeout 900 --durations 20

coverage: $(READY)
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term:skip-covered

mutants: $(READY)
	cd tests && PYTHONPATH=.. ../$(BIN)/python -m support.planted && PYTHONPATH=.. ../$(BIN)/python -m support.mutants

gate: $(READY)
	$(BIN)/python benchmarks/environment.py | $(BIN)/python benchmarks/gate.py results/performance/environment.json

# Needs uv and each Python, which uv can get.
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

# A benchmark that fails leaves its last result as it is, and the others go on.
bench: $(READY)
	@failed=; for name in $(BENCHMARKS); do \
	  echo "== $$name"; result=results/performance/$$name.json; \
	  if $(BIN)/python benchmarks/$$name.py > $$result.new; then mv $$result.new $$result; \
	  else rm -f $$result.new; failed="$$failed $$name"; fi; done; \
	$(BIN)/python benchmarks/table.py && $(BIN)/python benchmarks/simulate.py || exit 1; \
	test -z "$$failed" || { echo "failed:$$failed" >&2; exit 1; }

# For maintainers; needs uv.
lock:
	uv pip compile pyproject.toml --group dev --universal --python-version 3.11 --fork-strategy fewest \
	  --upgrade --no-header --no-annotate --generate-hashes --quiet --output-file requirements.lock

clean:
	rm -rf .venv build dist site *.egg-info .cache .hypothesis .import_linter_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
