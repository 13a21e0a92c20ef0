# make study [DATA=folder] [OUT=folder] [ARGS=...], make test, make check: each sets up what it needs.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
RUN := $(VENV)/bin/python
DATA ?=
OUT ?= results
ARGS ?=

# Most of the fast tests' time is compilation: they do without XLA's optimisation.
QUICK := --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0

.PHONY: study test test-slow lint types check clean

study: $(STAMP)
	$(RUN) experiments/study.py --data "$(DATA)" --out "$(OUT)" $(ARGS)

test: $(STAMP)
	XLA_FLAGS="$(QUICK)" $(RUN) -m pytest -q -n 2 --dist loadfile

test-slow: $(STAMP)
	$(RUN) -m pytest -q -m slow

lint: $(STAMP)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

types: $(STAMP)
	$(RUN) -m pyright

check: lint types

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q --disable-pip-version-check -c constraints.txt -e ".[study,pcd,camera,data,cli,physnet,cma,dev]"
	touch $@

clean:
	rm -rf $(VENV) results
