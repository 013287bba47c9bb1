# make demo    the whole path in front of you: record, score, decide, train, drive (6 minutes)
# make test    checks and tests, as CI runs them
# Each makes .venv by itself. A CPU-only torch: make TORCH_BACKEND=cpu demo

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What is installed; a smaller machine takes less, for instance EXTRAS=ros,test
EXTRAS ?= ros,sim,policy,test
# Any requirement on torch, for instance TORCH=torch==2.13.0
TORCH ?=
ifdef TORCH_BACKEND
export UV_TORCH_BACKEND := $(TORCH_BACKEND)
endif

.PHONY: setup demo test check bench clean

setup: $(VENV)/.ready

$(VENV)/.ready: setup.py pyproject.toml package.xml $(wildcard libexec/* launch/* config/*)
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if (3, 10) <= v[:2] <= (3, 13) else \
		f"error: Python 3.10 to 3.13 is needed, {sys.executable} is {v[0]}.{v[1]}: make PYTHON=...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
		{ echo "error: '$(PYTHON) -m venv' failed: install python3-venv"; exit 2; }
	@test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[$(EXTRAS)]' $(if $(TORCH),'$(TORCH)')
	@# An editable installation leaves out what ros2 run and ros2 launch look up.
	@$(BIN)/python setup.py --quiet install_data --install-dir $(abspath $(VENV))
	@touch $@

demo: setup
	@$(BIN)/curation demo

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: check
	$(BIN)/python -m pytest

bench: setup
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf $(VENV) build install log *.egg-info
