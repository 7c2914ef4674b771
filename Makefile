# One call of `onespp` a target. Everything below `setup` runs in the virtual environment it makes.
PROFILE ?= quick
# That of the profile's name, if there is one.
BUDGET ?= $(or $(filter tiny quick release furnished,$(PROFILE)),quick)
DATA ?= data/$(PROFILE)
RUNS ?= runs
PYTHON ?= python3

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
LLVM := libllvm19

.NOTPARALLEL:
.PHONY: all setup dataset train eval bench stress report test test-all blender lint clean

# Seconds since this call of make began, for the documentation.
START := $(shell date +%s)
SECONDS = $$(( $$(date +%s) - $(START) ))
# Whether this call does everything but set-up: what a later one takes says nothing.
FRESH := $(shell [ $(READY) -nt pyproject.toml ] && [ ! -e $(DATA) ] && [ ! -e $(RUNS) ] && echo yes)
# Whether tests are run for the first time after a `make` that kept its time.
FIRST_TEST := $(shell [ $(READY) -nt pyproject.toml ] && [ -e $(RUNS)/make.seconds ] && \
	[ ! -e $(RUNS)/test.seconds ] && echo yes)

all: dataset train eval report
	@$(if $(FRESH),echo $(SECONDS) > $(RUNS)/make.seconds,:)

setup: $(READY)

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "onespp needs Python 3.11 or newer: set PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@# Rendering on the CPU needs libLLVM; get it where that takes no password, else the message says what to install.
	@$(BIN)/python -c 'import render.backend' >/dev/null 2>&1 || { \
		if [ "$$(id -u)" = 0 ]; then apt-get update -qq && apt-get install -y -qq $(LLVM); \
		elif sudo -n true 2>/dev/null; then sudo apt-get update -qq && sudo apt-get install -y -qq $(LLVM); fi; } || true
	@$(BIN)/python -c 'import render.backend' || exit 1
	@touch $(READY)

dataset: $(READY)
	$(BIN)/onespp dataset --profile $(PROFILE) --data $(DATA)

train: $(READY)
	$(BIN)/onespp train --budget $(BUDGET) --data $(DATA) --runs $(RUNS)

eval: $(READY)
	$(BIN)/onespp eval --budget $(BUDGET) --data $(DATA) --runs $(RUNS)

bench: $(READY)
	$(BIN)/onespp bench denoisers --size 1280x720 1920x1080 128x128 --runs $(RUNS)  # the last is that of clips, for trade

stress: $(READY)
	$(BIN)/onespp stress --long --budget $(BUDGET) --runs $(RUNS)

report: $(READY)
	$(BIN)/onespp report --runs $(RUNS)

# Two tests at a time, each on one thread: threads that wait for each other would keep both cores busy. Tests of a file
# share what they prepare, so each file goes to one process.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile

test: $(READY)
	$(PYTEST)
	@$(if $(FIRST_TEST),echo $(SECONDS) > $(RUNS)/test.seconds,:)

# Blender as a Python module, with which test-all renders. It needs Python 3.11 and another numpy, so an environment of
# its own. `make test-all BLENDER=` goes without.
BLENDER ?= .venv-blender/.ready
BLENDER_PYTHON ?= $(PYTHON)

blender: .venv-blender/.ready

.venv-blender/.ready:
	$(BLENDER_PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
		{ echo "bpy needs Python 3.11: set BLENDER_PYTHON=/path/to/python3.11, or BLENDER= to go without"; exit 1; }
	$(BLENDER_PYTHON) -m venv .venv-blender
	.venv-blender/bin/python -m pip install --quiet --disable-pip-version-check bpy==5.0.1
	@touch $@

test-all: $(READY) $(BLENDER)
	$(PYTEST) -m '' --hypothesis-profile thorough $(if $(BLENDER),,--ignore tests/blender)

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

clean:
	rm -rf $(VENV) .venv-blender build *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
