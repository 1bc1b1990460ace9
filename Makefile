# make install   .venv with everything for one machine
# make test      every check and every test
# make demo      a synthetic scan through the whole service; SCAN=path/to/scan.zip takes yours
# make clean     removes what the others made

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --constraint constraints.txt
RUFF := $(BIN)/ruff

.PHONY: install test demo clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; (3, 11) <= v < (3, 13) or sys.exit( \
	    "Python 3.11 or 3.12 is needed, $(PYTHON) is %d.%d: try make PYTHON=python3.12" % v[:2])'
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make a .venv: apt-get install python3-venv, then run make again" >&2; exit 1; }
	@echo "installing into .venv ..."
	@$(PYTHON) -m venv .venv
	@$(PIP) --upgrade pip  # the one that came with Python may not know dependency groups
	@$(PIP) --editable '.[all]' --group dev
	@$(BIN)/python -m compileall -q client server worker  # else each process would, under PYTHONDONTWRITEBYTECODE
	@touch $@

test: install
	$(RUFF) check
	$(RUFF) format --check
	$(BIN)/mypy --num-workers 2
	$(BIN)/lint-imports
	# Three processes for two cores, since tests of services wait a lot; one thread each, since threads of two processes
	# wait for each other.
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 3 --dist worksteal

demo: install
	@.ci/demo $(if $(SCAN),'$(SCAN)')

clean:
	rm -rf .venv demo dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	rm -rf tests/engine/gltf_validator/node_modules
	find client server worker tests -name __pycache__ -type d -prune -exec rm -rf {} +
