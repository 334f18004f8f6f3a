# Every target does its own set-up: it makes the virtual environment, installs what it needs into it,
# and installs again where pyproject.toml, setup.py or constraints.txt have changed since.
#   make test PYTHON=python3.12       another interpreter
#   make demo OUT=runs/first          another run folder
#   make test DEVICE=cuda             on a GPU, what differs there; so does make bench

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
VERSIONS ?= 3.11-lowest 3.12-pinned 3.13-newest
OUT ?= runs/demo-$(shell date +%Y%m%d-%H%M%S)
ARGS ?=
DEVICE ?=

BIN := $(VENV)/bin
# One thread a process: the workers of the tests would otherwise fight over the cores.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1
# The tests force thousands of files to the disk; a folder in memory saves that wait, if it has room.
IN_MEMORY := $(shell df -Pk /dev/shm 2>/dev/null | \
  awk 'NR == 2 && $$4 > 4000000 {print "PYTEST_DEBUG_TEMPROOT=/dev/shm"}')
TESTED := $(BIN)
PYTEST = $(ONE_THREAD) $(IN_MEMORY) $(TESTED)/python -m pytest -n $(WORKERS) --dist worksteal

# Every process of the tests would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PRECIOUS: $(VENV)/installed-%
# The tests come last, also under `make -j`: their closing line ends the log.
.NOTPARALLEL:
.PHONY: help demo demo-memory test lint types unit slow numerics versions kill fuzz soak bench docs release format hooks clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-12s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/installed-recipes  ## Train TIT on CartPole without velocities, on one frame and on eight (3 minutes)
	$(BIN)/python -m recipes sweep docs/examples/histories.py --workers 2 --out $(OUT) $(ARGS)
	$(BIN)/python -m recipes compare $(OUT)/ppo/cartpole-no-velocity/*/seed-* --out $(OUT)/demo.png

demo-memory: $(VENV)/installed-recipes  ## Train four frames and TIT on a maze that only memory solves (about 3 minutes)
	$(BIN)/python -m recipes sweep ppo/tmaze-10/frames-4 ppo/tmaze-10/enhanced-tit \
	  --workers 2 --out $(OUT) $(ARGS)
	$(BIN)/python -m recipes compare $(OUT)/ppo/tmaze-10/*/seed-* --out $(OUT)/memory.png

test: lint types unit  ## Check style, types and behaviour: all that must pass

lint: $(VENV)/installed-test  ## Check style, formatting and which modules import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

types: $(VENV)/installed-test  ## Check types
	MYPY_NUM_WORKERS=$(WORKERS) $(BIN)/mypy

ON_DEVICE := tests/test_device.py tests/checkpoint/test_codec.py tests/datasets/test_online.py tests/datasets/test_storages.py tests/envs/test_vector.py

unit: $(VENV)/installed-test  ## Run the tests and the examples in docstrings (ARGS="-k history" for some)
	$(if $(DEVICE),DEVICE=$(DEVICE)) $(PYTEST) --durations 20 -m "not slow" $(ARGS) $(if $(DEVICE),$(ON_DEVICE))

slow: numerics  ## Run the tests that take long, and those of numbers on a plain processor
	$(PYTEST) --durations 20 -m slow $(ARGS)

# Processors differ in the order in which they add numbers up; this is the order of the plainest.
numerics: $(VENV)/installed-test  ## Compare numbers once more as a processor of another kind makes them
	ATEN_CPU_CAPABILITY=default $(PYTEST) -m "numerics and not slow" \
	  -k "not compile and not export" \
	  $$(grep -rlF --include='test_*.py' pytest.mark.numerics tests)

# Of the direct dependencies: the oldest that pyproject.toml allows, those of constraints.txt, and
# the newest. UV_PYTHON_DOWNLOADS=never uses the interpreters of this machine alone.
versions: $(addprefix versions/,$(VERSIONS))  ## Run the tests on the versions and Pythons allowed (30 GB; ARGS as above)

RESOLUTION_lowest := --resolution lowest-direct
RESOLUTION_pinned := -c constraints.txt

versions/%: TESTED = $(VENV)-$*/bin
versions/%: $(VENV)/installed-versions
	$(BIN)/uv venv --clear --seed --python $(word 1,$(subst -, ,$*)) $(VENV)-$*
	$(BIN)/uv pip install --compile-bytecode --python $(TESTED)/python \
	  $(RESOLUTION_$(word 2,$(subst -, ,$*))) -e '.[test]'
	$(PYTEST) $(ARGS)

# The runs are left in RUNS, which must be new to `make kill` and `make soak`.
RUNS ?= runs/reliability
MINUTES ?= 120

kill: $(VENV)/installed-test  ## Kill runs at random moments and resume them (45 minutes)
	$(ONE_THREAD) $(BIN)/python -m tests.reliability.kill --runs $(RUNS)/kill $(ARGS)

fuzz: $(VENV)/installed-test  ## Give 1,000 wrong inputs to recipes, networks, data sets and commands
	$(ONE_THREAD) $(BIN)/python -m tests.reliability.fuzz $(ARGS)

soak: $(VENV)/installed-test  ## Watch memory, files and speed of four runs for MINUTES=120
	$(ONE_THREAD) $(BIN)/python -m tests.reliability.soak --runs $(RUNS)/soak --minutes $(MINUTES) $(ARGS)

bench: $(VENV)/installed-bench  ## Measure speed against other libraries
	$(BIN)/python -m pip install --no-deps -r benchmarks/d3rlpy.txt
	$(ONE_THREAD) $(BIN)/python -m benchmarks $(if $(DEVICE),--device $(DEVICE)) $(ARGS)

# The commands and fields are read from the code; the site is built beside it, with packages of its own.
docs: $(VENV)/installed-recipes $(VENV)-docs/installed  ## Build the documentation site: build/site/index.html
	rm -rf build/docs
	$(ONE_THREAD) $(BIN)/python -m docs.tools.reference
	NO_MKDOCS_2_WARNING=1 $(VENV)-docs/bin/mkdocs build --strict --quiet

# Up to the upload: wheel, sdist, runs, site and notes, in RELEASE. URL is the repository's address.
RELEASE ?= build/release
PYTHONS ?= python3.11 python3.12 python3.13
URL ?=
SUITE ?=

release: $(VENV)/installed-release docs  ## Build and check what is published (SUITE=--suite: with the sdist's tests)
	rm -rf $(RELEASE) build/lib
	PROJECT_URL=$(URL) $(BIN)/python -m build --outdir $(RELEASE)
	$(BIN)/python -m docs.tools.archive docs/results --out $(RELEASE)/results.tar.xz
	tar -cJf $(RELEASE)/site.tar.xz -C build site
	$(ONE_THREAD) PROJECT_URL=$(URL) $(BIN)/python -m docs.tools.release $(RELEASE) --pythons $(PYTHONS) $(SUITE)

format: $(VENV)/installed-test  ## Rewrite the code in the project's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

hooks: $(VENV)/installed-test  ## Check every commit and push as `make test` does
	$(BIN)/pre-commit install

clean:  ## Remove the environment, builds and caches; runs stay
	rm -rf $(VENV) $(VENV)-* build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "torchrl-tit needs Python 3.11 or newer, and '$(PYTHON)' is not:" \
	    "make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

$(VENV)-docs/installed: docs/requirements.txt $(VENV)/created
	$(BIN)/python -m venv --clear $(VENV)-docs
	$(VENV)-docs/bin/python -m pip install -r docs/requirements.txt
	@touch $@

# The extra to install is the end of the stamp's name.
$(VENV)/installed-%: pyproject.toml setup.py constraints.txt $(VENV)/created
	$(BIN)/python -m pip install -c constraints.txt -e '.[$*]'
	@touch $@
