# `make demo` and `make test` do all their own set-up.
PYTHON ?= python3
BIN := .venv/bin
COMMA := ,
# What was installed before stays: INSTALLED extras, and CONSTRAINTS where others than ours were asked for.
-include .venv/installed.mk
CONSTRAINTS ?= constraints.txt
WANTED = $(sort $(INSTALLED) $(subst $(COMMA), ,$(EXTRAS)))
EMPTY :=
DOTTED = .$(if $(1),[$(subst $(EMPTY) $(EMPTY),$(COMMA),$(strip $(1)))])
PIP_INSTALL = $(BIN)/pip install --disable-pip-version-check --progress-bar off -c $(CONSTRAINTS) -e
# picamera2 and libcamera come from Raspberry Pi OS: the environment must see the system's packages.
VENV = $(PYTHON) -m venv $(if $(filter pi,$(WANTED)),--system-site-packages) .venv

LINKS = mkdir -p $(1)/buddyline && ln -sfn $(addprefix ../../../,$(wildcard buddyline/*.py) buddyline/py.typed protocol \
	node solver_service tools) $(1)/buddyline/
# Python asks an editable package's finder last: a folder named buddyline beside a program, such as the clone itself,
# would hide the package. A package on the path goes before such a folder. The line is relative to site-packages.
ON_PATH = $(call LINKS,.venv/names) && \
	for site in .venv/lib/python3*/site-packages; do echo ../../../names > "$$site/buddyline.pth"; done

.PHONY: demo test matrix coverage docs release install names clean

# Ctrl-C, which ends it with 130, is no error.
demo: .venv/.run
	@trap : INT; $(BIN)/buddyline demo $(ARGS) || [ $$? -eq 130 ]

test: .venv/.test names
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	cd build/names && ../../$(BIN)/lint-imports --config ../../pyproject.toml
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile

# The same tests on each Python, and with the lowest and the newest packages: five times as long.
matrix: .venv/.test
	$(BIN)/python -m tests.matrix $(ARGS)

# Traced, everything takes half as long again: too slow for the viewer of the soak on a slow machine.
coverage: .venv/.test
	$(BIN)/pytest --cov --cov-report=term:skip-covered

# The documents as a site in build/site; every link is checked.
docs: .venv/.test
	$(PIP_INSTALL) '$(call DOTTED,$(sort dev docs $(WANTED)))'
	$(BIN)/python docs/site/make.py build/site
	@echo "== build/site/index.html"

# What a tag releases, in dist: packages, notes, the list of all parts, hashes.
release:
	.ci/release

# make install EXTRAS=keys,monitor: adds extras (pyproject.toml lists them) to what is installed.
install: | .venv/bin/python
	@echo "== installing buddyline$(if $(WANTED), with $(WANTED)) into .venv"
	$(if $(filter pi,$(WANTED)),$(VENV))
	$(PIP_INSTALL) '$(call DOTTED,$(WANTED))'
	@$(ON_PATH)
	@printf '%s\n' 'INSTALLED := $(WANTED)' 'CONSTRAINTS := $(CONSTRAINTS)' > .venv/installed.mk
	@touch .venv/.run
	@echo "== installed: $(BIN)/buddyline --help; or '. $(BIN)/activate' first, then 'buddyline --help'"

# The four folders under their one import name, as an installation has them: what mypy and import-linter read.
names:
	@$(call LINKS,build/names)

.venv/bin/python:
	@echo "== setting up .venv; this takes one to three minutes, once"
	$(PYTHON) -c 'import sys; sys.exit("Buddyline needs Python 3.11 or newer: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	$(VENV)

.venv/.run: pyproject.toml constraints.txt | .venv/bin/python
	@echo "== installing the packages that buddyline needs"
	$(PIP_INSTALL) '$(call DOTTED,$(WANTED))'
	@$(ON_PATH)
	@touch $@

.venv/.test: pyproject.toml constraints.txt | .venv/bin/python
	@echo "== installing the packages that the tests need"
	$(PIP_INSTALL) '$(call DOTTED,$(sort dev $(WANTED)))'
	@$(ON_PATH)
	@touch $@ .venv/.run

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage
