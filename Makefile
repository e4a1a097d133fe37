# The commands of the project. Each works on a bare machine with Python 3.11 to 3.14 and nothing else.
# `make smoke`, then `make test`; see README.md.

PYTHON ?= python3
CORES ?= $(shell nproc 2>/dev/null || echo 2)
VENV := .venv
BIN := $(VENV)/bin
CAPTURE ?=
TORCH ?= auto

# Container images often set it. Without byte code every command compiles all that it imports, which takes it longer than
# to import torch: it is written once, into .venv and beside our own modules.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install smoke capture paper rehearsal rehearsal-small test test-fast bench docs pictures lint format ci lock clean help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 18

install:  ## make .venv with everything in it (pip only, no compiler); TORCH=auto|cpu|cuda says which build of torch
	@$(PYTHON) tools/install.py --venv $(VENV) --torch $(TORCH)

smoke: install  ## the whole pipeline on a tiny synthetic subject, then the tables
	$(BIN)/nbavatar run smoke --cores $(CORES)

capture: install  ## train and evaluate on your own capture: make capture CAPTURE=/path/to/folder
	@test -n "$(CAPTURE)" || { echo "say which capture: make capture CAPTURE=/path/to/folder"; exit 2; }
	$(BIN)/nbavatar run capture --cores $(CORES) "$(CAPTURE)"

paper: install  ## every table of the paper; needs the Decaf dataset and the body models
	$(BIN)/nbavatar run paper --cores $(CORES)

rehearsal: install  ## the paper on synthetic data of the dataset's size, in few frames and steps; hours on two cores
	$(BIN)/nbavatar run rehearsal --cores $(CORES)

SMALL := config/paper.yaml config/rehearsal.yaml config/rehearsal/small.yaml
rehearsal-small: install  ## the smallest rehearsal at true size: one synthetic subject, three cameras, every rule
	$(BIN)/nbavatar run rehearsal --cores $(CORES) -- --configfile $(SMALL)

# One thread a worker: two tests side by side are faster than one after the other on two threads. Files are begun in the
# order of tests/conftest.py, long ones first, not by how many tests they hold.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(CORES) --dist loadfile --no-loadscope-reorder

test: install  ## all tests, as in CI
	$(PYTEST)

test-fast: install  ## the tests that take seconds
	$(PYTEST) -m "not slow"

bench: install  ## benchmarks of the kernels
	$(BIN)/nbavatar bench raster
	$(BIN)/nbavatar bench deform
	$(BIN)/nbavatar bench spectral
	$(BIN)/nbavatar bench fit

docs: install  ## the documentation as a site: build/docs/docs/index.html
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . build/docs

pictures: install  ## the pictures of README.md and docs/, from a synthetic person; half an hour and more
	$(BIN)/python -m tools.pictures --cores $(CORES)

lint: install  ## formatting, style, types, layers, workflow
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/snakemake --lint --configfile config/smoke.yaml

format: install  ## format Python and Snakemake files
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow

ci: lint docs  ## what CI runs
	$(MAKE) smoke
	$(MAKE) test

lock:  ## resolve the locked versions anew; needs uv: make lock UPGRADE="--upgrade torch"
	$(PYTHON) tools/lock.py $(UPGRADE)

clean:  ## remove results of the smoke run (never those of others)
	rm -rf results/smoke logs/smoke benchmarks/smoke
