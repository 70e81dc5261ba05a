# Everything is done in a virtual environment, .venv, made with nothing but python3, venv and pip.
PYTHON ?= python3
BIN := .venv/bin
CACHE := $(CURDIR)/.cache
WORKERS ?= 2

.PHONY: demo test test-all lint bench clean

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --editable '.[test]'
	touch $@

demo: .venv/installed  ## The main job: a muscle-driven arm reaches in eight directions.
	$(BIN)/jaxctrl run centre-out --out results --force
	$(BIN)/jaxctrl show centre-out --out results

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

test: lint
	JAX_COMPILATION_CACHE_DIR=$(CACHE)/jax JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0.1 \
		$(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m 'not slow'

test-all: lint  ## Also the long reproductions, all of it as XLA compiles by default.
	XLA_FLAGS= $(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

bench: .venv/installed
	$(BIN)/jaxctrl bench

clean:
	rm -rf .venv .cache results build dist
