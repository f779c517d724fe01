# Everything runs in .venv; nothing needs to be installed before but Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
WORKERS ?= 2

# What is compiled once is kept, whatever the environment says: tests begin two processes for each that they are run by.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help install demo smoke test test-slow check measure audit format lock bench soak clean

help: ## List the targets.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(STAMP) ## Create .venv with the pinned packages.

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "betaloop needs Python 3.11 or newer; name one with: make install PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	@: # most modules are never imported: only those that are get their bytecode, below
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -r requirements.lock
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation -e .
	OMP_NUM_THREADS=1 $(BIN)/python tests/packages/bytecode.py
	@touch $(STAMP)

demo: install ## Start betaloop with a synthetic study at http://127.0.0.1:8000.
	$(BIN)/betaloop demo

smoke: install ## Walk once from an upload to a signed controller and back, within a minute: the first thing to run after a change.
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/app/pipeline/test_smoke.py

test: install ## Run the test suite.
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not slow"

test-slow: install ## Run learning curves and fault rounds (about 35 minutes on two cores).
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m slow

check: install ## Lint, types, the import contract, and known flaws of the pinned packages where a public list of them can be asked.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/packages/known_flaws.py

measure: install ## Print the measures of the code with their goals.
	$(BIN)/python -m tests.architecture.measure

audit: install ## Ask a public list for known flaws of the pinned packages, and fail where it cannot be asked.
	$(BIN)/python tests/packages/known_flaws.py --required

format: install ## Format the code and fix what the linter can.
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/python -m tests.architecture.templates --write

lock: ## Pin the installed packages in requirements.lock.
	$(BIN)/python -m pip freeze --exclude-editable --exclude betaloop --all | grep -v -i '^pip==' | sed 's/^torch==\([0-9.]*\).*/torch==\1/' > requirements.lock
	PYTHONPATH=. $(BIN)/python tests/packages/service_lock.py

bench: install ## Run every benchmark in its quick form.
	@for script in benchmarks/*.py; do echo "== $$script"; OMP_NUM_THREADS=1 $(BIN)/python $$script --quick || exit 1; done
	@for script in benchmarks/evaluation/*.py; do tool=$$(echo $${script%.py} | tr / .); \
	  echo "== $$tool"; OMP_NUM_THREADS=1 $(BIN)/python -m $$tool --quick || exit 1; done

soak: install ## Kill every process of an installation at random moments, 50 rounds (about 15 minutes), and look whether anything is lost.
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/soak.py

clean: ## Remove the demo's data and everything made here (not the code).
	rm -rf $(VENV) var build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
