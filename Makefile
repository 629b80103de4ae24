# A thin layer over pip: the README spells the same commands out.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: demo test test-fast check docs bench accuracy clean

demo: $(VENV)/.installed
	$(BIN)/bevviz demo

test: $(VENV)/.tested
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# The parts that are not ours to choose: data classes, pydantic, compiled kernels, ONNX, readers, the command line.
FAST = config perceive run clustering fusion tracking messages detector info
test-fast: $(VENV)/.tested
	$(BIN)/python -m pytest -q -n 2 --dist loadfile $(FAST:%=tests/test_%.py)

check: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs: $(VENV)/.tested
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "build/site/index.html; '$(BIN)/mkdocs serve' shows it while it is written"

bench: $(VENV)/.installed
	$(BIN)/python -m benchmarks.performance --write docs/performance.md

accuracy: $(VENV)/.tested
	$(BIN)/python -m benchmarks.accuracy --write docs/performance.md
	$(BIN)/python -m benchmarks.why --write docs/performance.md
	$(BIN)/python -m benchmarks.ground --write docs/performance.md
	$(BIN)/python -m benchmarks.anomalies --write docs/performance.md

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/pip install --quiet --editable ".[workbench]"
	touch $@

$(VENV)/.tested: $(VENV)/.installed
	$(BIN)/pip install --quiet --group dev --editable ".[ros]"
	touch $@

clean:
	rm -rf .venv* build dist
