# Every target does its own set-up: it makes the virtual environment, installs what it needs into it,
# and installs again where pyproject.toml, setup.py or constraints.txt have changed since.
#   make test PYTHON=python3.12       another interpreter
#   make demo OUT=runs/first          another run folder

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
OUT ?= runs/demo-$(shell date +%Y%m%d-%H%M%S)
ARGS ?=

BIN := $(VENV)/bin
# One thread a process: the workers of the tests would otherwise fight over the cores.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
# The tests come last, also under `make -j`: their closing line ends the log.
.NOTPARALLEL:
.PHONY: help demo test lint types numerics unit bench format hooks clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-10s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/installed-run  ## Train Enhanced_TIT with PPO on CartPole-v1 (about 5 minutes) into runs/
	$(BIN)/python -m recipes train ppo/cartpole/enhanced-tit --out $(OUT) $(ARGS)

test: lint types numerics unit  ## Check style, types and behaviour: all that must pass

lint: $(VENV)/installed-test  ## Check style, formatting and which modules import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

types: $(VENV)/installed-test  ## Check types
	$(BIN)/mypy

# Processors differ in the order in which they add numbers up; this is the order of the plainest.
numerics: $(VENV)/installed-test  ## Compare numbers once more as a processor of another kind makes them
	ATEN_CPU_CAPABILITY=default $(ONE_THREAD) $(BIN)/python -m pytest tests -n $(WORKERS) \
	  --dist worksteal -m "numerics and not slow" -k "not compile and not export"

unit: $(VENV)/installed-test  ## Run the tests and the examples in docstrings (ARGS="-k history" for some)
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

bench: $(VENV)/installed-bench  ## Measure speed against other libraries
	$(BIN)/python -m pip install --no-deps -r benchmarks/d3rlpy.txt
	$(ONE_THREAD) $(BIN)/python -m benchmarks $(ARGS)

format: $(VENV)/installed-test  ## Rewrite the code in the project's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

hooks: $(VENV)/installed-test  ## Check every commit and push as `make test` does
	$(BIN)/pre-commit install

clean:  ## Remove the environment, builds and caches; runs stay
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "torchrl-tit needs Python 3.11 or newer, and '$(PYTHON)' is not:" \
	    "make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

# The extra to install is the end of the stamp's name; 'run' stands for none.
$(VENV)/installed-%: pyproject.toml setup.py constraints.txt $(VENV)/created
	$(BIN)/python -m pip install -c constraints.txt -e '.$(patsubst [run],,[$*])'
	@touch $@
