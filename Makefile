# Each target first makes its own environment. The only requirement is Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ALL_BUILDS := $(VENV)/.all_builds
EDITABLE := $(BIN)/python -m pip install --quiet --no-compile --editable

.PHONY: demo test slow lint fuzz sanitize bench gpu-check page clean

demo: $(READY)  ## renders a small synthetic capture, trains on it, and prints the path of the scene's page
	$(BIN)/splatax demo --out runs/demo --overwrite

test: $(READY)  ## runs all tests except those of `make slow`
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal -m "not slow and not other_build"

slow: $(ALL_BUILDS)  ## runs the tests that take many seconds each, such as whole commands on real captures, and those of builds for other CPUs
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal -m "slow or other_build" --durations 25

FUZZ_SECONDS ?= 60
fuzz: $(READY)  ## feeds damaged files to every reader, a minute for each kind
	SPLATAX_FUZZ_SECONDS=$(FUZZ_SECONDS) $(BIN)/python -m pytest tests/io/test_fuzz.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Most of the time is spent in XLA's compiler, whose memory accesses are checked too. It therefore runs with few
# optimizations (tests/conftest.py), and sanitizers keep short stack traces and a small quarantine. Of the builds, the
# baseline and the best one that runs here are tested, the baseline of x86 by the address sanitizer alone. Only one
# low-pass filter is, because native code gets it as a number. Without a number of jobs, --parallel would compile all
# files at once.
SANITIZED := build/sanitize
HEADERS := build/headers
BEST = $(shell $(BIN)/python -c "from splatax.backends.cpu import library; print(library.best_instructions())")
JAXLIB := $(shell sed -n 's/.*"\(jaxlib==[^"]*\)".*/\1/p' pyproject.toml)
sanitize: $(READY) $(HEADERS)/.ready  ## runs the tests of the native library under the address and undefined-behaviour sanitizers
	PYTHONPATH=$(abspath $(HEADERS)) cmake -S . -B $(SANITIZED) -DPython_EXECUTABLE=$(abspath $(BIN)/python) -DSPLATAX_SANITIZE=address,undefined
	cmake --build $(SANITIZED) --target splatax_instructions splatax_baseline splatax_$(BEST) --parallel $(shell getconf _NPROCESSORS_ONLN)
	LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libubsan.so) $$($(CXX) -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0:malloc_context_size=1:quarantine_size_mb=16 \
	  SPLATAX_NATIVE=$(abspath $(SANITIZED)) \
	  $(BIN)/python -m pytest tests/contracts tests/backends tests/bench --numprocesses auto --dist worksteal \
	    -k "(test_cpu or cpu-$(BEST) or cpu-baseline or drawn_slots or peak) and not low_pass1" -m "not slow" --durations 25

# The jaxlib whose headers the library is built with. The tests run with the installed one.
$(HEADERS)/.ready: pyproject.toml | $(READY)
	$(BIN)/python -m pip install --quiet --no-deps --no-compile --upgrade --target $(HEADERS) '$(JAXLIB)'
	touch $@

bench: $(READY)  ## times the renderer and writes runs/bench
	$(BIN)/splatax bench --out runs/bench

# The target gpu-check neither builds nor installs anything, so that it runs on a GPU machine without network. splatax
# and its dependencies must be installed for $(GPU_PYTHON).
GPU_PYTHON ?= python3
gpu-check:  ## checks the CUDA backend on this GPU and measures its speed; writes runs/gpu-check
	PYTHONPATH=src:tests $(GPU_PYTHON) -m gpu_check --out runs/gpu-check

VIEWER := src/splatax/web/viewer.js
page: $(VIEWER)  ## builds the viewer of `splatax page` (needs Node.js)

$(VIEWER): web/package-lock.json web/build.mjs $(wildcard web/src/*.js)
	npm --prefix web ci --no-audit --no-fund
	npm --prefix web run build

clean:
	rm -rf $(VENV) build dist web/node_modules $(VIEWER)

# Python compiles a module when it is first imported. Most of the ten thousand that are installed never are. The native
# library is built for this machine; the other builds, which take longer, are added for the tests that need them.
$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "splatax needs Python 3.11 or newer; try make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --upgrade pip
	$(EDITABLE) '.[test]' --config-settings=cmake.define.SPLATAX_BUILDS=native
	touch $@

$(ALL_BUILDS): $(READY)
	$(EDITABLE) . --no-deps --config-settings=cmake.define.SPLATAX_BUILDS=all
	touch $@
