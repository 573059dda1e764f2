# Needs only Python >= 3.11 with venv, and make.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
WARM := .venv/.compiled

# What `make test` leaves to `make test-all`; each test that is not slow is in one of the two.
HEAVY := (engine or system or docs) and not representative

.PHONY: demo test test-all test-heavy test-slow lint format lock audit benchmark docs clean

demo: $(STAMP)
	$(BIN)/shm-monitor demo

test: $(WARM) lint
	$(BIN)/python -m pytest -n auto --dist loadscope -m "not slow and not ($(HEAVY))"

# All that is not slow: `make test`, then what it leaves out.
test-all: test test-heavy

# Diagnoses side by side; then whole commands, daemons and browsers one by one, for they watch clocks and ports.
test-heavy: $(WARM) test
	$(BIN)/python -m pytest -n auto --dist loadscope -m "not slow and engine and not representative"
	$(BIN)/python -m pytest -m "not slow and not engine and $(HEAVY)"

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow --timeout 7200 -s

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: $(STAMP)
	$(BIN)/python tests/benchmarks/speed.py

# The API reference from docstrings, in out/api.
docs: $(STAMP)
	$(BIN)/python docs/api.py out/api

# Writes versions and hashes, no address.
lock: $(STAMP)
	$(BIN)/pip install uv
	$(BIN)/uv pip compile --quiet --upgrade --generate-hashes --no-annotate --no-header --python-version 3.11 requirements.in -o requirements.txt

# The pinned packages against published faults, by a tool in an environment of its own; needs the network.
audit:
	$(PYTHON) -m venv out/audit
	out/audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	out/audit/bin/pip-audit --disable-pip --require-hashes -r requirements.txt

# Compiled functions are kept on the disk: made once, here, and not by several tests at the same time.
$(WARM): $(STAMP) $(shell grep -rl "^@compiled" monitor)
	$(BIN)/shm-monitor replay recordings/mini-shake-table-flexible.mcap \
		--structure recordings/mini-shake-table-flexible.toml --out out/warm/replay >/dev/null
	$(BIN)/shm-monitor diagnose recordings/frame-before.mcap --structure recordings/frame.toml --out out/warm/diagnosis >/dev/null
	touch $(WARM)

$(STAMP): requirements.txt pyproject.toml
	@echo "Installing into .venv (1.7 GB; a minute or more, silently) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $(STAMP)

clean:
	rm -rf .venv out
