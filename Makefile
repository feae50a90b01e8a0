# Every target sets up what it needs: a virtual environment in the tree, packages by name.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Recorded data for the tests marked `data`; they are left out where it is absent.
ifneq ($(wildcard ../shared/data/README.md),)
export UMFELD_DATA ?= $(abspath ../shared/data)
endif
PYTEST := $(BIN)/python -m pytest
JOBS ?= 2

.PHONY: help venv demo test lint bench fuzz soak hil interop format clean

help:  ## This list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

venv: $(VENV)/.installed  ## The virtual environment with the command `umfeld`

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: venv  ## An emulated robot, the daemon and the live page; prints the address (Ctrl-C ends it)
	$(BIN)/umfeld demo $(ARGS)

test: venv lint  ## Everything that must hold: lint, types, arrows, all tests
	$(PYTEST) -n $(JOBS) --dist loadfile $(ARGS)

lint: venv  ## ruff, mypy strict, import-linter
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: venv  ## Lay out the code
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

clean:  ## Take away what the targets made
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis out
