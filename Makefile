# make run: the whole way on the quadruple tank. make test: everything that is checked.
# Needs Python 3.11 or newer, make and a C compiler; the rest is installed into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
WORKERS ?= 2
# The matrices are small: threads inside BLAS cost more than they bring.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help run test test-long mutants firmware prove prove-long notebook notebooks docs lint format lock benchmarks clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

$(VENV)/.installed: requirements.lock pyproject.toml setup.py tools/bootstrap.sh
	PYTHON="$(PYTHON)" sh tools/bootstrap.sh "$(VENV)"
	@touch $@

run: $(VENV)/.installed ## quadruple tank: derive, design, prove, simulate, generate C, report
	$(BIN)/obsynth run quadruple-tank --out "$(OUT)/quadruple-tank"

test: $(VENV)/.installed lint ## lint, types and all tests except the long statistics
	$(BIN)/python -m pytest -m "not long" -n $(WORKERS) --dist worksteal

test-long: $(VENV)/.installed ## the long statistics only; MINUTES=25: what is not begun by then is left out, and counted
	$(BIN)/python -m pytest -m long -n $(WORKERS) --dist worksteal --durations=40 --durations-min=5 \
	  $(if $(MINUTES),--minutes $(MINUTES))

mutants: $(VENV)/.installed ## plant mistakes in what guarantees rest on, print those that no test sees
	$(BIN)/python tools/mutants.py --workers $(WORKERS) --minutes 6

firmware: $(VENV)/.installed ## the C of every method on emulated Cortex-M3, M4F and M7
	sh tools/install.sh firmware
	$(BIN)/python tools/firmware --workers $(WORKERS)

prove: $(VENV)/.installed ## prove and search the C of every method: Eva, MISRA, compilers, libFuzzer
	sh tools/install.sh prove
	$(BIN)/python tools/prove --workers $(WORKERS)

prove-long: $(VENV)/.installed ## the same with the fuzzer on everything, for a minute each
	sh tools/install.sh prove
	$(BIN)/python tools/prove --workers $(WORKERS) --long --fuzz 60

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed ## rewrite the sources in the house's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

notebook: $(VENV)/.installed ## open JupyterLab on the notebooks
	$(BIN)/jupyter lab notebooks

notebooks: $(VENV)/.installed ## execute the notebooks and store what they show, where it has changed
	$(BIN)/python tools/notebooks.py

docs: $(VENV)/.installed ## build the documentation as a site, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

benchmarks: $(VENV)/.installed ## measure against peers, tables on the terminal
	for script in benchmarks/[a-z]*.py; do $(BIN)/python $$script || exit 1; done

lock: $(VENV)/.installed ## resolve requirements.lock anew (needs uv)
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-header --upgrade -o requirements.lock

clean: ## remove everything that was installed or generated
	rm -rf $(VENV) out site build dist *.egg-info src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
