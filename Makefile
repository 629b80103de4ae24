# A thin layer over uv, which pip installs first. CONTRIBUTING.md has the same commands for pip alone.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

# The versions that the tests passed with. CONSTRAINTS= takes the newest that pyproject.toml allows.
CONSTRAINTS ?= docs/constraints.txt
INSTALL = VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet $(CONSTRAINTS:%=--constraint %)
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# One part of N of the long tests, as K/N. All of them without it.
SHARE ?= 0/1

.PHONY: demo test test-long test-fast check page-check docs bench accuracy constraints sbom wheel clean

demo: $(VENV)/.installed
	$(BIN)/bevviz demo

test: $(VENV)/.tested
	$(PYTEST) -m "not long"

test-long: $(VENV)/.tested
	$(PYTEST) -m long --share $(SHARE)

# The parts that are not ours to choose: data classes, pydantic, compiled kernels, ONNX, readers, the command line.
FAST = config perceive run clustering fusion tracking messages detector info
test-fast: $(VENV)/.tested
	$(PYTEST) -q -m "not long" $(FAST:%=tests/test_%.py)

check: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The page's scripts: types, rules and tests. It needs Node.js 18 or newer, with npm.
page-check: $(BIN)/python tests/page/node_modules/.installed
	$(BIN)/python -m tools.make_page_types
	tests/page/node_modules/.bin/tsc --project tests/page
	tests/page/node_modules/.bin/eslint --config tests/page/eslint.config.js bevviz/workbench/page tests/page tests/support
	node --test tests/page/*.test.js

tests/page/node_modules/.installed: tests/page/package-lock.json
	npm ci --prefix tests/page --no-audit --no-fund
	touch $@

docs: $(VENV)/.tested
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "build/site/index.html; '$(BIN)/mkdocs serve' shows it while it is written"

bench: $(VENV)/.installed
	$(BIN)/python -m benchmarks.performance --write benchmarks/RESULTS.md

accuracy: $(VENV)/.tested
	$(BIN)/python -m benchmarks.accuracy --write benchmarks/RESULTS.md
	$(BIN)/python -m benchmarks.ideal --half unseen --write benchmarks/RESULTS.md
	$(BIN)/python -m benchmarks.ground --write benchmarks/RESULTS.md
	$(BIN)/python -m benchmarks.anomalies --write benchmarks/RESULTS.md
	$(BIN)/python -m benchmarks.rigs --write benchmarks/RESULTS.md

# Renew the versions. Commit the result when make test and make check pass with it.
constraints: .venv-release/.installed
	.venv-release/bin/uv pip compile pyproject.toml --upgrade --universal --fork-strategy fewest --python-version 3.11 \
		--all-extras --group dev --group release --no-annotate --custom-compile-command "make constraints" --quiet \
		--output-file docs/constraints.txt

# List what a user installs. The tool runs in another environment, so that it does not list itself.
sbom: .venv-release/.installed
	$(MAKE) VENV=.venv-user .venv-user/.installed
	mkdir -p dist
	.venv-release/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible \
		--output-file dist/bevviz.cdx.json .venv-user/bin/python

# What a release publishes. tools/check_wheel.py installs the wheel alone and runs the demo.
wheel: .venv-release/.installed
	rm -rf dist
	.venv-release/bin/python -m build --outdir dist .
	.venv-release/bin/twine check --strict dist/*
	.venv-release/bin/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	.venv-release/bin/check-jsonschema --builtin-schema vendor.github-actions action.yml

$(VENV)/.installed: pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet "uv>=0.9,<1"
	$(INSTALL) --editable ".[workbench]"
	touch $@

$(BIN)/python: # An environment of another make serves as well.
	$(MAKE) $(VENV)/.tested

$(VENV)/.tested: $(VENV)/.installed
	$(INSTALL) --group dev --editable ".[ros]"
	touch $@

.venv-release/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-release
	.venv-release/bin/pip install --quiet --upgrade "pip>=25.1,<27"
	.venv-release/bin/pip install --quiet --group release
	touch $@

clean:
	rm -rf .venv* build dist tests/page/node_modules
