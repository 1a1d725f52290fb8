# Needs Python >= 3.11 and make, nothing else. README.md has the plain pip / python commands.
VENV ?= .venv
PYTHON ?= python3
WORKERS ?= 2

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow lint benchmark clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' Makefile

setup: $(STAMP)  ## create $(VENV) and install the package with its test tools

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("$(PYTHON) is Python %d.%d; needs >= 3.11: make PYTHON=/path/to/python3.11" % sys.version_info[:2])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[test,lpips]'
	@touch $@

demo: setup  ## train on the built-in scene, print PSNR, write a turntable and a deformed animation
	$(BIN)/python experiments/demo.py --workdir=out/demo

test: setup  ## run the tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test-slow: setup  ## run the tests that take minutes
	$(BIN)/python -m pytest -m slow

lint: setup  ## ruff and mypy
	$(BIN)/ruff check src experiments tests
	$(BIN)/mypy

benchmark: setup  ## time training and rendering (JSON)
	$(BIN)/python experiments/benchmark.py

clean:  ## remove the environment, outputs and caches
	if [ -e $(VENV)/pyvenv.cfg ]; then rm -rf $(VENV); fi
	rm -rf out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +
