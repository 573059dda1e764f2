# Needs only Python >= 3.11 with venv, and make.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
DEV := .venv/.installed-dev
WARM := .venv/.compiled

# What `make test` leaves to `make test-all`; each test that is not slow is in one of the two.
HEAVY := (engine or system or docs) and not representative

# A tier's wall and CPU time, and where in the tests it went, are kept in out/times: tests/times.py.
TIER := $(BIN)/python -m tests.times run
PYTEST := $(BIN)/python -m pytest -p tests.times

LOCK := out/lock/bin/uv pip compile --quiet --generate-hashes --no-annotate --no-header --python-version 3.11

SEED ?= 1
MUTANTS ?= 60
TREE ?= .

.PHONY: demo test test-all test-heavy test-slow mutation lint format lock audit benchmark docs site sizes wheels clean

demo: $(STAMP)
	$(BIN)/shm-monitor demo

test: $(WARM)
	$(TIER) lint $(MAKE) --no-print-directory lint
	$(TIER) default $(PYTEST) -n auto --dist loadscope -m "not slow and not ($(HEAVY))"

# All that is not slow: `make test`, then what it leaves out.
test-all: test test-heavy

# Diagnoses side by side; then whole commands, daemons and browsers, three at a time, for they wait more than they compute.
test-heavy: $(WARM) test
	$(TIER) engine $(PYTEST) -n auto --dist loadscope -m "not slow and engine and not representative"
	$(TIER) system $(PYTEST) -n 3 --dist loadscope -m "not slow and not engine and $(HEAVY)"

# Goes on after an interruption: what passed, and each kept trial, is not run again while the code is the same (out/references).
test-slow: $(DEV)
	$(BIN)/python -m pytest -p tests.support.resumed -m slow --timeout 7200 -s

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(DEV)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Small faults put into the product: which do no tests notice? tests/mutation.py tells more; hours, resumable.
mutation: $(WARM)
	$(BIN)/pip install --quiet --disable-pip-version-check --target out/mutation/packages/operators cosmic-ray==8.7.0
	$(BIN)/pip install --quiet --disable-pip-version-check --target out/mutation/packages/coverage coverage==7.17.5
	echo "import coverage; coverage.process_startup()" > out/mutation/packages/coverage/sitecustomize.py
	PYTHONPATH=out/mutation/packages/coverage $(BIN)/python -m tests.mutation --seed $(SEED) --mutants $(MUTANTS) --tree $(TREE)

benchmark: $(DEV)
	$(BIN)/python tests/benchmarks/speed.py

# The API reference from docstrings, in out/api.
docs: $(DEV)
	$(BIN)/python docs/api.py out/api

# The pages of docs/ as a site that needs no network, in out/site.
site: $(DEV)
	$(BIN)/python docs/site_builder.py out/site

# Writes versions and hashes, no address: what is needed to run, what tests and development add to it, what a site's daemon may use.
lock:
	$(PYTHON) -m venv out/lock
	out/lock/bin/pip install --quiet --disable-pip-version-check uv
	$(LOCK) --upgrade requirements.in -o requirements.txt
	$(LOCK) --upgrade -c requirements.txt requirements-dev.in -o requirements-dev.txt
	$(LOCK) --upgrade -c requirements-dev.txt deploy/requirements.in -o deploy/requirements.txt

# The size of an environment of each kind, the time to start; installs the core alone in out/core, so it needs the network.
sizes: $(DEV)
	$(BIN)/python docs/sizes.py

# Asks whether each pinned package has a wheel for 64-bit ARM; needs the network.
wheels: $(DEV)
	$(BIN)/python docs/wheels.py

# The pinned packages against published faults, by a tool in an environment of its own; needs the network.
audit:
	$(PYTHON) -m venv out/audit
	out/audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	out/audit/bin/pip-audit --disable-pip --require-hashes -r requirements-dev.txt

# Compiled functions are kept on the disk: made once, here, and not by several tests at the same time.
$(WARM): $(DEV) $(shell grep -rl "^@compiled" monitor)
	$(BIN)/shm-monitor replay recordings/mini-shake-table-flexible.mcap \
		--structure recordings/mini-shake-table-flexible.toml --out out/warm/replay >/dev/null
	$(BIN)/shm-monitor diagnose recordings/frame-before.mcap --structure recordings/frame.toml --out out/warm/diagnosis >/dev/null
	touch $(WARM)

$(STAMP): requirements.txt pyproject.toml
	@echo "Installing into .venv (1.2 GB; a minute or more, silently) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $(STAMP)

$(DEV): $(STAMP) requirements-dev.txt
	@echo "Adding what tests and development need (1.4 GB more; a minute or more, silently) ..."
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.txt
	touch $(DEV)

clean:
	rm -rf .venv out
