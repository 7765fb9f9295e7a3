# A fresh machine needs Python 3.10 or newer and make; everything else goes into .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto  # one thread each: they share the cores
INSTALL := $(PIP) install --quiet --constraint constraints.txt

.PHONY: demo test coverage test-fast fuzz lint types wheel docs clean

# Plans the tours of the examples with the shipped network and says where the pictures are.
demo: $(VENV)/.demo
	$(BIN)/mtsp solve examples/*.tsp --agents 4 --augment --reconstruct 16 --plot tours.png

# The whole test suite on all cores.
test: $(VENV)/.dev
	$(PYTEST)

# The same, but lists the lines of mtsp_env and dan_policy that no test runs, and fails if more than 5 % are missed. Counting
# lines makes the tests of the rules take almost twice as long; from Python 3.12 on, COVERAGE_CORE=sysmon should make it cheaper.
coverage: $(VENV)/.dev
	$(PYTEST) --cov --cov-report=term

# The quick tests alone, on all cores: about a minute on two slow cores.
test-fast: $(VENV)/.dev
	$(PYTEST) -m "not slow and not gpu"

# 10,000 broken inputs for each reader of files, on all cores; the ordinary tests try 100. Prints counts and times.
fuzz: $(VENV)/.dev
	$(BIN)/python -m pytest tests/fuzz -m fuzz --hypothesis-profile=fuzz --hypothesis-show-statistics --numprocesses auto

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

# The source distribution and the wheel, and whether package indexes would show their descriptions.
wheel: $(VENV)/.dev
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*

# The site, in docs/_build/html. Runs the notebooks, and fails on any warning.
docs: $(VENV)/.dev
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs docs/_build/html

# torch goes first and alone: pip then takes a CPU build if it finds one, and the packages after it accept that build.
$(VENV)/.demo: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --upgrade pip
	$(INSTALL) torch
	$(INSTALL) --editable ".[dan,render]"
	touch $@

$(VENV)/.dev: $(VENV)/.demo
	$(INSTALL) --editable ".[all]" --group dev
	touch $@

clean:
	rm -rf $(VENV) build dist docs/_build *.egg-info .coverage .coverage.* .mypy_cache .nox .pytest_cache .ruff_cache
