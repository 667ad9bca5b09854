# The two commands that matter: `make demo` and `make test`. Each works first on a fresh clone.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TEST_STAMP := $(VENV)/.installed-for-tests
# One more than there are cores: some tests wait for disks, timers and other processes.
TEST_WORKERS := $(shell expr $$(nproc 2>/dev/null || echo 1) + 1)
# Python compiles a module when it first imports it, and most of what comes along never is: compiling
# it all takes longer than unpacking. Where Python may not keep what it has compiled, pip does it.
COMPILE := $(if $(PYTHONDONTWRITEBYTECODE),,--no-compile)

.DEFAULT_GOAL := help
.PHONY: help setup setup-tests demo test test-all lint bench check-system clean

help:
	@echo "make demo   install, render the embedded street under five recipes, say where the pictures are"
	@echo "make test   install, run the test suite"
	@echo "make test-all  also what takes long: soaks, sweeps, hundreds of kills, clusters, benches"
	@echo "make lint   formatting, style and types"
	@echo "make bench  time the rasteriser on this machine"

# What the demo takes, and what the tests take besides: three times as much.
setup: $(STAMP)

setup-tests: $(TEST_STAMP)

# torch comes first and alone: constraints.txt pins the version whose CPU build pip finds.
$(STAMP): pyproject.toml constraints.txt | check-system
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade "pip>=23.1"
	$(BIN)/pip install --quiet $(COMPILE) torch --constraint constraints.txt
	$(call install,".")
	touch $@

$(TEST_STAMP): $(STAMP)
	$(call install,".[test]")
	touch $@

install = $(BIN)/pip install --quiet $(COMPILE) --constraint constraints.txt --editable $(1) \
	>$(VENV)/install.log 2>&1 || { cat $(VENV)/install.log; exit 1; }

check-system:
	@command -v $(PYTHON) >/dev/null || { \
	  echo "$(PYTHON) was not found: install Python 3.11, or run make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c "$$MISSING_LIBRARIES"

# open3d, which finds the road where nothing else says where it is, is loaded only then. Without
# these libraries the rest works, so they are asked for and not insisted on.
define MISSING_LIBRARIES
import ctypes, sys
needed = {
    "libusb-1.0.so.0": "libusb-1.0-0", "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6", "libgomp.so.1": "libgomp1",
}
missing = []
for name, package in needed.items() if sys.platform == "linux" else ():
    try:
        ctypes.CDLL(name)
    except OSError:
        missing.append(package)
if missing:
    print(
        "open3d cannot be loaded without", ", ".join(missing), "(Debian's names), so that the road "
        "is looked for without it. Install with: apt-get install", *missing, file=sys.stderr,
    )
endef
export MISSING_LIBRARIES

demo: setup
	$(BIN)/climategs demo

PYTEST := $(BIN)/python -m pytest -q --numprocesses $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder

test: setup-tests
	$(PYTEST) -m "not long"

test-all: setup-tests
	$(PYTEST)

lint: setup-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

bench: setup
	$(BIN)/climategs bench raster

clean:
	rm -rf $(VENV) build out *.egg-info .pytest_cache .ruff_cache
