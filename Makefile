# Each target makes its own environment first; nothing needs to be installed but Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test quick lint bench clean

demo: $(READY)  ## trains on a small capture that it makes itself, and prints where the report is
	$(BIN)/splatax demo --out runs/demo --overwrite

test: $(READY)  ## all tests
	$(BIN)/python -m pytest

quick: $(READY)  ## without the slow ones
	$(BIN)/python -m pytest -m "not slow"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## times the renderer and writes runs/bench
	$(BIN)/splatax bench --out runs/bench

clean:
	rm -rf $(VENV) build dist

$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "splatax needs Python 3.11 or newer; try make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@
