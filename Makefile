PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BUNDLE ?= models/pointgoal1
# A worker a core, and a file's tests in one worker: they share what is slow to start.
PARALLEL ?= --numprocesses=logical --maxprocesses=4 --dist=loadfile

.PHONY: help setup demo test test-long lint format benchmark clean

help: ## what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(VENV)/.installed ## install everything into .venv

# One stamp for the whole installation: made anew when what is installed changes.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[train,sweep,fleet,test]'
	@# Loading a bundle compiles the filter; its machine code is kept beside the source.
	$(BIN)/python -c 'from monitor import Monitor; Monitor.load("$(BUNDLE)")'
	touch $@

demo: setup ## the robot in MuJoCo, driven through POST /act, with and without the filter
	$(BIN)/python -m evaluation.demo $(BUNDLE) --out demo

test: setup ## the test suite
	$(BIN)/python -m pytest $(PARALLEL)

test-long: setup ## the tests that take longer
	$(BIN)/python -m pytest -m long $(PARALLEL)

lint: setup ## ruff and mypy, as CI runs them
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup ## let ruff rewrite the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: setup ## every measurement, one after the other
	$(BIN)/python -m benchmarks.simulation
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.filter
	$(BIN)/python -m benchmarks.server $(BUNDLE)
	$(BIN)/python -m benchmarks.recording $(BUNDLE)
	$(BIN)/python -m benchmarks.soak $(BUNDLE)
	$(BIN)/python -m benchmarks.live $(BUNDLE)
	$(BIN)/python -m benchmarks.fleet $(BUNDLE)

clean: ## remove what make made
	rm -rf $(VENV) demo build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
