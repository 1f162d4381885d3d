# make demo       simulate a walk, run the odometry on it, compare with the truth, write demo/report.html
# make test       run the test suite, but for what takes long
# make test-slow  run the rest of it: long recordings, many repetitions, whole commands
# make lint       ruff and mypy
# make docs       the documentation as a site, site/index.html; a warning is an error
#
# Each target sets up what it needs in .venv, once. PYTHON names another interpreter, 3.11 or later.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
OUTPUT ?= demo
JOBS ?= 2
PYTEST_ARGS ?=
DEMO_ARGS ?=

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input --quiet --quiet

.PHONY: demo test test-slow lint docs clean

demo: $(VENV)/.runtime
	@$(BIN)/boxplus demo -o $(OUTPUT) $(DEMO_ARGS)

test: $(VENV)/.dev
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" $(PYTEST_ARGS)

test-slow: $(VENV)/.dev
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m slow $(PYTEST_ARGS)

lint: $(VENV)/.dev
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

docs: $(VENV)/.docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs --quiet build
	@echo "site/index.html"

clean:
	rm -rf $(VENV) $(OUTPUT) site

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "boxplus needs Python 3.11 or later; '$(PYTHON)' is $$($(PYTHON) --version 2>&1). Name another: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "creating $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv --clear $(VENV) >/dev/null 2>&1 || \
	  { $(PYTHON) -m venv --clear --without-pip $(VENV) && $(PYTHON) -m pip --quiet --quiet --python $(BIN)/python install pip; }
	@touch $@

$(VENV)/.runtime: pyproject.toml $(VENV)/.python
	@echo "installing boxplus and what it needs into $(VENV) (once; about a minute)"
	@$(PIP) install -e '.[report]'
	@touch $@

$(VENV)/.dev: pyproject.toml $(VENV)/.python
	@echo "installing boxplus and the tools for its tests into $(VENV) (once; about a minute)"
	@$(PIP) install -e '.[dev,vision,fleet,sensors]'
	@$(PIP) install --no-deps 'ouster-sdk>=1.0' || echo "no ouster-sdk for this platform: captures of Ouster are not tested"
	@touch $(VENV)/.runtime $@

$(VENV)/.docs: pyproject.toml $(VENV)/.python
	@echo "installing boxplus and the tools for its site into $(VENV) (once; about a minute)"
	@$(PIP) install -e '.[docs]'
	@touch $(VENV)/.runtime $@
