# Everything a fresh machine needs is Python 3.10 or newer and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint wheel clean

# The tours of the examples, planned by the shipped DAN; prints where the picture is.
demo: $(STAMP)
	$(BIN)/mtsp solve examples/*.tsp --agents 4 --plot tours.png

# The environment and the whole test suite.
test: $(STAMP)
	$(BIN)/python -m pytest

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

wheel: $(STAMP)
	$(BIN)/python -m build --wheel

# torch first and alone: on Linux without a GPU its exact pin may be a CPU build, which later requirements must find.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
