PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-all fuzz docs check clean

demo: $(VENV)/installed
	$(BIN)/jvr demo -o jvr-demo --force

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile

test-all: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m "" -n auto --dist loadfile --no-loadscope-reorder

# So many damaged files of each format.
FUZZ ?= 100000

fuzz: $(VENV)/installed-dev
	$(BIN)/python tests/fuzz/parent.py $(FUZZ)

# The site, build/docs/index.html; what Sphinx warns of is an error.
docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -q -W --keep-going -c docs . build/docs
	cp build/docs/README.html build/docs/index.html

check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

$(BIN)/python:
	$(or $(shell command -v $(PYTHON)),python3) -m venv $(VENV)

$(VENV)/installed: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet -e .
	touch $@

$(VENV)/installed-dev: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet -e ".[dev]"
	touch $(VENV)/installed $@

$(VENV)/installed-docs: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet -e ".[docs]"
	touch $(VENV)/installed $@

clean:
	rm -rf $(VENV) build docs/reference jvr-demo
