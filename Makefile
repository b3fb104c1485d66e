# Everything sets itself up: a virtual environment in .venv with pinned versions (constraints.txt).
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
BPY_42 := 4.2.23
BPY_45 := 4.5.15
LIBS := libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1
.DEFAULT_GOAL := help

help:            ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

$(VENV)/.ready: pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing: install Python 3.11 (apt install python3.11 python3.11-venv), or set PYTHON=…"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@$(BIN)/python -c 'import bpy' 2>/dev/null || { echo 'Blender needs system libraries: installing $(LIBS)'; \
		SUDO=$$([ $$(id -u) = 0 ] || echo sudo); $$SUDO apt-get update -qq && $$SUDO apt-get install -y -qq $(LIBS); }
	@$(BIN)/python -c 'import bpy'
	@touch $@

setup: $(VENV)/.ready ## the environment alone

demo: $(VENV)/.ready ## render, reconstruct and export a procedural animated object into out/demo
	$(BIN)/timesplat demo --out out/demo

test: lint ## lint, types and all tests; types beside the tests, most of which use one core
	@$(MAKE) --no-print-directory -j2 types unit

unit: $(VENV)/.ready
	$(BIN)/python -m pytest

lint: $(VENV)/.ready ## ruff alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.ready ## mypy alone; the link gives the package its name whatever this folder is called
	@mkdir -p $(VENV)/types && ln -sfn ../.. $(VENV)/types/timesplat
	$(BIN)/mypy

test-blender: $(VENV)/.ready ## the add-on's tests under BLENDER=/path/to/blender, or a Python that has bpy
	TIMESPLAT_BLENDER=$(BLENDER) $(BIN)/python -m pytest tests/blender

test-blenders: .venv-bpy42/.ready .venv-bpy45/.ready $(VENV)/.ready ## the add-on's tests under bpy 4.2, 4.5 and 5.0
	@for v in 42 45; do echo "bpy $$v"; $(MAKE) --no-print-directory test-blender BLENDER=$(CURDIR)/.venv-bpy$$v/bin/python || exit; done
	@echo "bpy 5.0"; $(MAKE) --no-print-directory test-blender

.venv-bpy%/.ready:
	$(PYTHON) -m venv .venv-bpy$*
	.venv-bpy$*/bin/python -m pip install --quiet --disable-pip-version-check bpy==$(BPY_$*) numpy==1.26.4
	@touch $@

zip: $(VENV)/.ready ## the Blender extension, into dist/
	$(BIN)/timesplat extension --out dist

clean:           ## what can be made again
	rm -rf $(VENV) .venv-bpy* out dist build *.egg-info

.PHONY: help setup demo test lint types unit test-blender test-blenders zip clean
