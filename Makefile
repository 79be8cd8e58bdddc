# `make label` and `make test` do everything on a fresh machine; `make help` lists the rest.
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs
PRESET ?= laptop
MODEL ?= resnet50
WEIGHTS ?=
TIME ?= 840
SCALE := $(if $(filter file,$(origin PRESET)),paper,$(PRESET))
RUN := $(OUT)/$(if $(filter field,$(MODEL)),field,train)/$(PRESET)
EXTRAS ?= dev
TRAVJAX_DATA ?= $(wildcard ../shared/data)
YARD := $(TRAVJAX_DATA)/terrain/mars_yard.tif
export TRAVJAX_DATA

.DEFAULT_GOAL := help
.PHONY: help setup label train gpu own-python test test-all check bench docs clean

help:
	@echo "make setup   create $(VENV) with everything that the other targets need"
	@echo "make label   make and label 200 synthetic maps and the Mars Yard, into $(OUT)/label"
	@echo "make train   train an estimator and evaluate it, into $(RUN); PRESET=smoke|laptop|workstation|paper ($(PRESET)),"
	@echo "             MODEL=resnet50|field ($(MODEL)); resnet50 begins with ImageNet weights: WEIGHTS=FILE, those of"
	@echo "             TRAVJAX_DATA or of the cache, else they are fetched (95 MB); WEIGHTS=none for random ones"
	@echo "             on an NVIDIA GPU: make clean, then make train PRESET=paper EXTRAS=dev,cuda"
	@echo "make gpu     on an NVIDIA GPU, measure, train and evaluate as much as fits into TIME seconds ($(TIME)), into"
	@echo "             $(OUT)/gpu; again goes on; PRESET=smoke|paper (paper), WEIGHTS as above; EXTRAS=cuda installs JAX"
	@echo "             for it, BIN=DIR takes the programs of a Python that has everything and needs no network"
	@echo "make test    run the tests; make test-all: the slow ones too"
	@echo "make check   lint, types and layering"
	@echo "make bench   measure speed, into $(OUT)/bench"
	@echo "make docs    build the documentation, into docs/_build/html"
	@echo "make clean   remove $(VENV), $(OUT) and caches"

setup: $(VENV)/.ready

# Names are no proof: a pyenv shim called python3.13 may run nothing.
$(VENV)/.ready: pyproject.toml constraints.txt
	@for python in $(PYTHON) python3 python3.13 python3.12 python3.11 python; do \
	  if $$python -c 'import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; \
	  then found=$$python; break; fi; done; \
	if [ -z "$$found" ]; then \
	  echo "make: no Python 3.11, 3.12 or 3.13 with venv and ensurepip runs here; install one, or name it: make PYTHON=..." >&2; \
	  exit 2; fi; \
	echo "Setting up $(VENV) with $$found, about a minute ..."; \
	rm -rf $(VENV) && $$found -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[$(EXTRAS)]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps jax2onnx
	@touch $@

label: setup
	$(BIN)/travjax label --count 200 --seed 0 --out $(OUT)/label/synthetic
	@if [ -f "$(YARD)" ]; then \
	  $(BIN)/travjax label "$(YARD)" --out $(OUT)/label/mars_yard; \
	else \
	  echo "No Mars Yard: terrain/mars_yard.tif is not under TRAVJAX_DATA='$(TRAVJAX_DATA)'; only synthetic maps were labelled."; \
	fi

# Large pages for what malloc gives: a training step on a CPU takes a sixth less time with them.
train: export GLIBC_TUNABLES ?= glibc.malloc.hugetlb=1
train: setup
	$(BIN)/travjax train $(PRESET) --model $(MODEL) $(if $(WEIGHTS),--weights $(WEIGHTS)) --resume --out $(RUN)
	$(BIN)/travjax evaluate $(RUN)
	@echo
	@echo "Other presets: make train PRESET=smoke (3 minutes), PRESET=laptop (45 minutes), PRESET=workstation (2 hours), PRESET=paper EXTRAS=dev,cuda (a GPU; make clean before)."
	@echo "The hazard field: make train MODEL=field PRESET=smoke (1 minute), PRESET=laptop (an hour); it needs no ImageNet weights."
	@echo "Another robot: $(BIN)/travjax train $(PRESET) --model $(MODEL) --robot husky_a200 --out DIR"

# With a BIN of its own nothing is fetched: that Python has the dependencies and JAX for the GPU.
gpu: $(if $(filter $(VENV)/bin,$(BIN)),setup,own-python)
	$(BIN)/python -m travjax.experiments.gpu $(SCALE) --time $(TIME) $(if $(WEIGHTS),--weights $(WEIGHTS)) --out $(OUT)/gpu/$(SCALE)

own-python:
	$(BIN)/python -m pip install --quiet --no-deps --no-index --no-build-isolation --editable .

test: setup
	$(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder -m "not slow"

test-all: setup
	$(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_layering.py

bench: setup
	$(BIN)/travjax bench --out $(OUT)/bench
	GLIBC_TUNABLES=glibc.malloc.hugetlb=1 $(BIN)/travjax bench --network --out $(OUT)/bench

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	@touch $@

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs docs/_build/html
	@echo "The documentation is in docs/_build/html/index.html"

clean:
	rm -rf $(VENV) $(OUT) build docs/_build docs/api docs/records *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
