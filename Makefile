# Everything from python3 and make alone: `make demo` sets up .venv first.
#
# On Linux, PyPI's torch brings several GB of CUDA libraries. Where no GPU is to be used, avoid them with
#   make demo PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"

PYTHON ?= python3
PIP_ARGS ?=
MINUTES ?= 10
VENV := .venv
RUN := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed
TYPED := $(foreach room,visadapt renderers datasets experiments train benchmarks tests,$(if $(wildcard $(room)/*.py),$(room)))

.DELETE_ON_ERROR:
.PHONY: demo demo-from-scratch test fuzz lint types format clean

demo: $(INSTALLED)
	$(RUN) -m train.demo

demo-from-scratch: $(INSTALLED)
	$(RUN) -m train.demo --from-scratch

test: $(INSTALLED)
	$(RUN) -m pytest -n auto --dist worksteal

# Damaged files for every reader; those that are neither read nor refused are kept in tests/crashes, as tests.
fuzz: $(INSTALLED)
	$(RUN) -m tests.fuzz --minutes $(MINUTES)

lint: $(INSTALLED)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(MAKE) --no-print-directory types

types: $(INSTALLED)
	$(RUN) -m mypy -n auto $(TYPED)

format: $(INSTALLED)
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

# The stamp comes last, so that an interrupted set-up is taken up again.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "visadapt needs Python 3.11 or later: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[camera,logs,onnx,mujoco,dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
