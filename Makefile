# Needs Python 3.11+, make and a package registry; everything else goes into .venv.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses=2
INPUTS := pyproject.toml constraints.txt
DEMO_READY := .venv/.ready-demo
DEV_READY := .venv/.ready-dev

.DEFAULT_GOAL := help
.PHONY: help demo test quick lint format install

help:
	@echo "make demo    reconstruct the bundled clip and score it"
	@echo "make test    all tests"
	@echo "make quick   the tests that take seconds"
	@echo "make lint    formatting, lint and types, changing nothing"
	@echo "make format  format and fix what can be fixed"
	@echo "make install the environment for development, in .venv"

demo: $(DEMO_READY)
	$(BIN)/mvdyn demo

test: $(DEV_READY)
	$(PYTEST)

quick: $(DEV_READY)
	$(PYTEST) -m "not slow"

lint: $(DEV_READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(DEV_READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

install: $(DEV_READY)

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "$(PYTHON) is missing or older than 3.11: run make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv .venv

# The stamps are touched last, so an interrupted installation is taken up again.
$(DEMO_READY): $(INPUTS) | .venv/bin/python
	$(PIP) --editable '.[eval,view]'
	@touch $@

$(DEV_READY): $(INPUTS) | .venv/bin/python
	$(PIP) --editable '.[eval,view,dev]'
	@touch $@ $(DEMO_READY)
