# make demo    the whole path in front of you: record, score, decide, train, drive (5 minutes)
# make test    checks and tests, as CI runs them
# make docs    docs/metrics.md anew, from the code
# make bench   the benchmarks (half an hour)
# make benchmark   the paper's experiment: collect, score, select, train, roll out, report (an hour)
# Each makes .venv by itself. A CPU-only torch: make TORCH_BACKEND=cpu demo

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What is installed; a smaller machine takes less, for instance EXTRAS=ros,test
EXTRAS ?= ros,sim,policy,report,test
# Any requirement on torch, for instance TORCH=torch==2.13.0
TORCH ?=
ifdef TORCH_BACKEND
export UV_TORCH_BACKEND := $(TORCH_BACKEND)
endif
# Of the extras, so that asking for others installs them.
READY := $(VENV)/.ready-$(EXTRAS)

.PHONY: setup demo test check bench benchmark docs clean

setup: $(READY)

$(BIN)/uv:
	@command -v $(PYTHON) >/dev/null || { echo "error: no $(PYTHON) here: make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit((3, 10) > v[:2] or v[:2] > (3, 13))' || \
		{ echo "error: Python 3.10 to 3.13 is needed, this is $$($(PYTHON) --version): make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) >/dev/null || \
		{ rm -rf $(VENV); echo "error: $(PYTHON) cannot make $(VENV): apt install python3-venv" >&2; exit 2; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

$(READY): setup.py package.xml curation_ros/nodes/programs.py $(wildcard launch/* config/*) | $(BIN)/uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[$(EXTRAS)]' $(if $(TORCH),'$(TORCH)')
	@# An editable installation leaves out what ros2 run and ros2 launch look up; colcon does this too.
	@$(BIN)/python -W ignore setup.py --quiet install_data --install-dir $(abspath $(VENV))
	@touch $@

demo: setup
	@$(BIN)/curation demo

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python docs/make_metrics.py --check

test: check
	$(BIN)/python -m pytest

docs: setup
	$(BIN)/python docs/make_metrics.py

bench: setup
	$(BIN)/python benchmarks/run.py

# It goes on where it was; another study: make benchmark STUDY=config/question.yaml
STUDY ?= config/paper.yaml
benchmark: setup
	@$(BIN)/curation benchmark --config $(STUDY)

clean:
	rm -rf $(VENV) build install log *.egg-info .*_cache .hypothesis
