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
# Patience with an index that is slow or resets connections; in the environment, so that builds of packages have it, too.
PIP := PIP_RETRIES=8 PIP_DEFAULT_TIMEOUT=60 PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --quiet
JOBS ?= 2
FUZZ_CASES ?= 300000
FUZZ_ROUNDS ?= 10
SOAK ?= 20

.PHONY: help venv demo test lint bench ledger fuzz soak hil interop format clean

help:  ## This list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

venv: $(VENV)/.installed  ## The virtual environment with the command `umfeld`

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	for try in 1 2 3; do $(PIP) -c constraints.txt -e '.[dev]' && exit 0; sleep 10; done; exit 1
	touch $@

demo: venv  ## An emulated robot, the daemon and the live page; prints the address (Ctrl-C ends it)
	$(BIN)/umfeld demo $(ARGS)

test: venv lint  ## Everything that must hold: lint, types, arrows, all tests
	$(PYTEST) -n $(JOBS) --dist loadfile --no-loadscope-reorder $(ARGS) || { \
	  test $$? -eq 1 || exit 1; \
	  echo "What failed beside other work is run once more, alone: whatever fails again fails the run."; \
	  $(PYTEST) --last-failed --last-failed-no-failures none -x $(ARGS); }

lint: venv  ## ruff, mypy strict, import-linter
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: venv  ## Latency, load, start and kernels against their budgets (docs/performance.md)
	$(BIN)/umfeld bench --all $(ARGS)

ledger: venv  ## Every emulated device under every fault: docs/fault-ledger.md anew
	$(BIN)/python -m bench.fault_ledger $(ARGS)

hil: venv  ## Driver tests on hardware: make hil DEVICE=laser=/dev/ttyACM0 (docs/testing.md)
	$(if $(DEVICE),,$(error name the hardware: make hil DEVICE=laser=/dev/ttyACM0))
	$(PYTEST) -m hil $(addprefix --device ,$(DEVICE)) $(ARGS)

fuzz: venv  ## Damaged bytes and random scenes, far more than `make test` tries
	UMFELD_FUZZ_CASES=$(FUZZ_CASES) $(PYTEST) tests/fuzz -n $(JOBS) --timeout 3600 $(ARGS)
	for round in $$(seq $(FUZZ_ROUNDS)); do $(PYTEST) -q -x -n $(JOBS) tests/property --hypothesis-profile new --hypothesis-seed $$RANDOM $(ARGS) || exit 1; done

soak: venv  ## Everything with real wires again and again, SOAK times, stopping at the first failure
	for round in $$(seq $(SOAK)); do echo "round $$round"; $(PYTEST) -q -x tests/loop tests/crash $(ARGS) || exit 1; done
	UMFELD_LAPS=200 $(PYTEST) -q -x tests/world/test_room_ids_laps.py --timeout 3600 $(ARGS)

interop: venv  ## Against other people's programs, where they are installed
	@if [ -d tests/interop ]; then $(PYTEST) tests/interop $(ARGS); else echo "no tests/interop in this tree"; fi

format: venv  ## Lay out the code
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

clean:  ## Take away what the targets made
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis out
