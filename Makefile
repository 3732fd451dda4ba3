# Everything runs in an environment of its own, made on first use.
PYTHON ?= python3
# A torch that is installed as it is here; any from pyproject.toml's range serves.
TORCH ?= torch==2.13.0
BIN := .venv/bin
# As many tests at a time as this process has cores; neighbours mostly share a process, which then makes
# their fixtures and kernels once.
WORKERS ?= $(shell nproc 2>/dev/null || echo auto)
# Else each of some fifty processes would compile all of torch and this package anew (3 s).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo reproduce test lint clean

demo: .venv/installed
	$(BIN)/nfriction demo --out runs/demo

reproduce: .venv/installed
	$(BIN)/nfriction reproduce --quick --out runs/papers

# Every process would rewrite the assertions of all files to show their values (10 s); tests that fail
# run once more with them.
test: .venv/installed
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --assert plain -m "not slow" || \
	{ $(BIN)/python -m pytest --last-failed --last-failed-no-failures none; false; }

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Python compiles a module when it is first imported; most of those installed never are.
.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile "$(TORCH)" --editable ".[test,dev]"
	touch $@

clean:
	rm -rf .venv runs build dist
