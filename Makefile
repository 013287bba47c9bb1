# make demo    the whole path in front of you: record, score, decide, train, drive (5 minutes)
# make quick   checks, and the tests that need no ROS, simulator or torch (a minute)
# make test    checks and all tests, as CI runs them
# make docs    writes the generated pages of docs
# make bench   the benchmarks (half an hour)
# make benchmark   the paper's experiment: collect, score, select, train, roll out, report (an hour)
# Each makes .venv by itself. A CPU-only torch: make TORCH_BACKEND=cpu demo

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Extras to install. On a small machine, take fewer, for instance EXTRAS=ros,test
EXTRAS ?= ros,sim,policy,report,test
# A requirement on torch, for instance TORCH=torch==2.13.0
TORCH ?=
ifdef TORCH_BACKEND
export UV_TORCH_BACKEND := $(TORCH_BACKEND)
endif
# A stamp per set of extras, so that asking for others installs them.
READY := $(VENV)/.ready-$(EXTRAS)
# For `make quick`, any installation with the extra test will do.
QUICK := $(firstword $(wildcard $(VENV)/.ready-*test) $(VENV)/.ready-test)
PYTEST := $(BIN)/python -m pytest
# The tests of a file stay together, because they share fixtures.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile

.PHONY: setup demo quick test check bench benchmark docs clean

setup: $(READY)

$(BIN)/uv:
	@command -v $(PYTHON) >/dev/null || { echo "error: no $(PYTHON) here: make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit((3, 10) > v[:2] or v[:2] > (3, 13))' || \
		{ echo "error: Python 3.10 to 3.13 is needed, this is $$($(PYTHON) --version): make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) >/dev/null || \
		{ rm -rf $(VENV); echo "error: $(PYTHON) cannot make $(VENV): apt install python3-venv" >&2; exit 2; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

$(VENV)/.ready-%: setup.py package.xml curation_ros/nodes/programs.py $(wildcard launch/* config/*) | $(BIN)/uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[$*]' $(if $(TORCH),'$(TORCH)')
	@# An editable installation leaves out the files that ros2 run and ros2 launch look for.
	@$(BIN)/python -W ignore setup.py --quiet install_data --install-dir $(abspath $(VENV))
	@touch $@

demo: setup
	@$(BIN)/curation demo

define CHECKS
$(BIN)/ruff check .
$(BIN)/ruff format --check .
$(BIN)/mypy
$(BIN)/lint-imports --no-logo
$(BIN)/python docs/make_metrics.py --check
$(BIN)/python docs/make_api.py --check
endef

check: setup
	$(CHECKS)

quick: $(QUICK)
	$(CHECKS)
	@# One thread of linear algebra per worker, because more threads wait for each other.
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(PYTEST) $(PARALLEL) -m 'not ros and not sim and not policy and not slow'

# The tests of the graph come last and one by one: they share the machine with their nodes.
test: check
	$(PYTEST) $(PARALLEL) -m 'not ros'
	$(PYTEST) -m ros

docs: setup
	$(BIN)/python docs/make_metrics.py
	$(BIN)/python docs/make_api.py

bench: setup
	$(BIN)/python benchmarks/run.py

# It resumes. Another study: make benchmark STUDY=config/question.yaml
STUDY ?= config/paper.yaml
benchmark: setup
	@$(BIN)/curation benchmark --config $(STUDY)

clean:
	rm -rf $(VENV) build install log libexec *.egg-info .*_cache .hypothesis
