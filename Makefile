# `make demo` and `make test` do all their own set-up.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test coverage install names clean

demo: .venv/.run
	$(BIN)/buddyline demo $(ARGS)

test: .venv/.test names
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	cd build/names && ../../$(BIN)/lint-imports --config ../../pyproject.toml
	$(BIN)/pytest

# Traced, everything takes half as long again: too slow for the viewer of the soak on a slow machine.
coverage: .venv/.test
	$(BIN)/pytest --cov --cov-report=term:skip-covered

install: .venv/.run

# The four folders under their one import name, as an installation has them: what mypy and import-linter read.
names:
	mkdir -p build/names/buddyline
	ln -sfn $(addprefix ../../../,buddyline/__init__.py buddyline/__main__.py buddyline/py.typed) build/names/buddyline/
	ln -sfn $(addprefix ../../../,protocol node solver_service tools) build/names/buddyline/

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("Buddyline needs Python 3.11 or newer: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv

.venv/.run: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

.venv/.test: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@ .venv/.run

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage
