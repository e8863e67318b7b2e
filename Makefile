# `make run`  sets up .venv and runs the whole job on the default campaign into ./data.
# `make test` adds what the checks need, and passes every check that needs Python alone.
# `make test-all` installs outside programs, such as a browser, and passes the checks that need them or minutes.
# `make report` does what `make run` does, then writes ./data/report/report.html.
# `make report MODEL=gated` adds hard driving and slippery roads before, and reports on the model with gates.
# `make docs` builds the pages as a site, ./site/index.html; a warning is an error. It lists figures that are older than the code.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
VERSION_OF = $(1) -c 'import platform; print(platform.python_version())'
PYTHON_VERSION := $(shell $(call VERSION_OF,$(PYTHON)))
CAMPAIGN ?= waterford
MODEL ?= $(CAMPAIGN)
ROOT ?= data
# Tests start the program hundreds of times: its compiled modules are kept, whatever the environment says.
export PYTHONDONTWRITEBYTECODE :=

# uv installs in seconds; pip, which comes with Python, installs the same where uv cannot be had or cannot reach the registry.
define INSTALL
$(BIN)/uv pip install --python $(BIN)/python --constraint constraints.txt $(1) || \
	  $(BIN)/python -m pip install --constraint constraints.txt $(1)
endef

.PHONY: run report gated test tests test-all lint docs setup bench clean

run: setup
	$(BIN)/fleet-slip --root $(ROOT) run --campaign $(CAMPAIGN)

report: run $(filter gated,$(MODEL))
	$(BIN)/fleet-slip --root $(ROOT) evaluate $(MODEL)
	$(BIN)/fleet-slip --root $(ROOT) report $(MODEL)

gated: run
	$(BIN)/fleet-slip --root $(ROOT) simulate proving_ground
	$(BIN)/fleet-slip --root $(ROOT) gram
	$(BIN)/fleet-slip --root $(ROOT) gram --features gated --cohort "campaign IN ('waterford', 'proving_ground')"
	$(BIN)/fleet-slip --root $(ROOT) show gated > /dev/null 2>&1 || \
	$(BIN)/fleet-slip --root $(ROOT) publish gated --models gated --cohort "lost_control_s IS NULL \
	  AND (campaign = 'waterford' OR campaign = 'proving_ground' AND vehicle_model = 'd_class_sedan')"

# What has one process at a time runs beside the tests, which have two.
test: $(VENV)/.dev-installed
	$(MAKE) --no-print-directory -j 2 lint tests

tests: $(VENV)/.dev-installed
	$(BIN)/pytest -n 2 --dist worksteal

test-all: $(VENV)/.dev-installed
	-PATH="$(abspath $(BIN)):$$PATH" tests/tools/install
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/pytest -n 2 --dist worksteal -rs --tools

lint: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

docs: $(VENV)/.docs-installed
	$(BIN)/python -m benchmarks.measured_page
	$(BIN)/python -m zensical build --clean --strict
	(printf 'window.searchIndex = '; cat site/search.json) > site/search.js

bench: $(VENV)/.dev-installed
	$(BIN)/python -m benchmarks

setup: $(VENV)/.installed

# The environment is made again if PYTHON is another version than its own.
$(VENV)/.python-$(PYTHON_VERSION):
	test "$$($(call VERSION_OF,$(BIN)/python) 2>&1)" = "$(PYTHON_VERSION)" || $(PYTHON) -m venv --clear $(VENV)
	touch $@

# What running needs, what the checks need, and what the pages need.
$(VENV)/.installed: pyproject.toml constraints.txt $(VENV)/.python-$(PYTHON_VERSION)
	$(BIN)/python -m pip install --quiet --upgrade --constraint constraints.txt pip
	-$(BIN)/python -m pip install --quiet --constraint constraints.txt uv
	$(call INSTALL,--editable .)
	touch $@

$(VENV)/.dev-installed: $(VENV)/.installed
	$(call INSTALL,--editable . --group dev)
	touch $@

$(VENV)/.docs-installed: $(VENV)/.dev-installed
	$(call INSTALL,--group docs)
	touch $@

clean:
	rm -rf $(VENV) .cache site .mypy_cache .pytest_cache .ruff_cache
