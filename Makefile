# `make run`  sets up .venv and runs the whole job on the default campaign into ./data.
# `make test` adds what the checks need, and passes every check that needs Python alone.
# `make test-all` installs outside programs, such as a browser, and passes the checks that need them.
# `make report` does what `make run` does, then writes ./data/report/report.html.
# `make docs` builds the pages as a site, ./site/index.html; a warning is an error.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CAMPAIGN ?= waterford
ROOT ?= data
# Tests start the program hundreds of times: its compiled modules are kept, whatever the environment says.
export PYTHONDONTWRITEBYTECODE :=

# uv installs in seconds where it is there; pip comes with Python.
INSTALL := $(if $(shell command -v uv),uv pip install --python $(BIN)/python,$(BIN)/python -m pip install)

.PHONY: run report test test-all lint docs setup bench clean

run: setup
	$(BIN)/fleet-slip --root $(ROOT) run --campaign $(CAMPAIGN)

report: run
	$(BIN)/fleet-slip --root $(ROOT) evaluate --one-car $(CAMPAIGN)
	$(BIN)/fleet-slip --root $(ROOT) report --model $(CAMPAIGN)

test: lint
	$(BIN)/pytest -n 2

test-all: $(VENV)/.dev-installed
	-tests/tools/install
	$(BIN)/pytest -n 2 -rs --tools

lint: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

docs: $(VENV)/.docs-installed
	$(BIN)/python -m zensical build --clean --strict

bench: $(VENV)/.dev-installed
	$(BIN)/python -m benchmarks

setup: $(VENV)/.installed

# What running needs, what the checks need, and what the pages need.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade --constraint constraints.txt pip
	$(INSTALL) --constraint constraints.txt --editable '.[compiled,report]'
	touch $@

$(VENV)/.dev-installed: $(VENV)/.installed
	$(INSTALL) --constraint constraints.txt --editable '.[compiled,report]' --group dev
	touch $@

$(VENV)/.docs-installed: $(VENV)/.dev-installed
	$(INSTALL) --constraint constraints.txt --group docs
	touch $@

clean:
	rm -rf $(VENV) .cache site .mypy_cache .pytest_cache .ruff_cache
