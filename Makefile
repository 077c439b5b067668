# make demo    try it: assess the bundled samples and open the dashboard
# make test    run all tests
# make test-extras   tests of the optional extras, which it installs (large)
# make lint    check style and types
# make serve   open the dashboard
# make lock    pin the newest versions that fit pyproject.toml
# make clean   remove the environment and caches
#
# PYTHON=...   the Python (3.11 or later) the environment is made from
# ARGS=...     more options for the command, for example: make test ARGS="-k rnle"

CANDIDATES := python3 python3.13 python3.12 python3.11 python3.14 python
NEW_ENOUGH := -c "import sys; sys.exit(sys.version_info < (3, 11))"
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	if $$p $(NEW_ENOUGH) >/dev/null 2>&1; then echo $$p; break; fi; done)

# All paths are relative: the folder's own name may have spaces.
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
BROWSERS := chromium chromium-browser google-chrome google-chrome-stable
DEFINITION := pyproject.toml requirements.lock

.DEFAULT_GOAL := help
.PHONY: help demo serve test test-extras lint format chromium postgres lock clean

help:
	@sed -n '/^#/!q; s/^# \{0,1\}//p' Makefile

demo: .venv/.installed
	$(BIN)/python -m engine.cli_start demo $(ARGS)

serve: .venv/.installed
	$(BIN)/python -m engine.cli_start serve $(ARGS)

test: .venv/.installed-dev chromium postgres
	$(BIN)/python -m pytest $(ARGS)

# Optional extras are large (PyTorch, OpenSim); their tests have a call of their own.
test-extras: .venv/.installed-dev
	$(BIN)/python -m pip install --no-compile -e ".[opensim,train,anny]"
	$(BIN)/python -m pytest -m extra $(ARGS)

lint: .venv/.installed-dev
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy

format: .venv/.installed-dev
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

# The browser tests drive a Chromium of the system; only root can install one.
chromium:
	@for name in $(BROWSERS); do \
		if command -v $$name >/dev/null; then exit 0; fi; \
	done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "Installing Chromium for the browser tests."; \
		{ apt-get update -q && DEBIAN_FRONTEND=noninteractive \
			apt-get install -q -y --no-install-recommends chromium; } || \
		echo "Chromium could not be installed; the browser tests will say so." >&2; \
	else \
		echo "No Chromium found, and only root can install one here: the browser tests are" \
			"skipped. Install Chromium or Chrome to run them." >&2; \
	fi

# The library's tests run on PostgreSQL too, on a server of their own in a temporary folder.
postgres:
	@for program in initdb /usr/lib/postgresql/*/bin/initdb; do \
		if command -v "$$program" >/dev/null; then exit 0; fi; \
	done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "Installing PostgreSQL for the library's tests."; \
		{ apt-get update -q && DEBIAN_FRONTEND=noninteractive \
			apt-get install -q -y --no-install-recommends postgresql; } || \
		echo "PostgreSQL could not be installed; its tests will say so." >&2; \
	else \
		echo "No PostgreSQL server found, and only root can install one here: its tests are" \
			"skipped. Install PostgreSQL to run them." >&2; \
	fi

lock: .venv/.made
	$(PIP) pip-tools
	$(BIN)/python -m piptools compile --upgrade --extra dev --strip-extras --no-annotate --no-header \
		--no-emit-index-url --no-emit-trusted-host --no-emit-find-links --quiet \
		--output-file requirements.lock pyproject.toml

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

.venv/.made:
	@if [ -z "$(PYTHON)" ]; then \
		echo "LiftLens needs Python 3.11 or later, and none was found; install it, or name it:" \
			"make demo PYTHON=/path/to/python3" >&2; exit 1; \
	elif ! "$(PYTHON)" $(NEW_ENOUGH); then \
		echo "LiftLens needs Python 3.11 or later, and $(PYTHON) is not; name another:" \
			"make demo PYTHON=/path/to/python3" >&2; exit 1; \
	elif ! "$(PYTHON)" -c "import ensurepip, venv" 2>/dev/null; then \
		echo "$(PYTHON) can't make environments; install its venv module (Debian, Ubuntu:" \
			"apt install python3-venv)." >&2; exit 1; \
	fi
	"$(PYTHON)" -m venv .venv
	@touch $@

.venv/.installed: .venv/.made $(DEFINITION)
	@echo "Installing LiftLens into .venv (a few minutes the first time)."
	$(PIP) --no-compile --constraint requirements.lock --editable .
	@touch $@

.venv/.installed-dev: .venv/.made $(DEFINITION)
	@echo "Installing LiftLens and what its tests need into .venv."
	$(PIP) --no-compile --constraint requirements.lock --editable ".[dev]"
	@touch .venv/.installed $@
