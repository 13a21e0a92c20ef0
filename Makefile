# make study [PRESET=name] [DATA=folder] [OUT=folder] [WORKERS=number] [ARGS=...], make test, make
# check, make docs: each sets up what it needs.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
RUN := $(VENV)/bin/python
DATA ?=
OUT ?= results
ARGS ?=
PRESET ?= small
WORKERS ?= 2

# Most of the fast tests' time is compilation: they do without XLA's optimisation. Two processes of
# one thread each: threads that wait for each other cost more than they compute.
QUICK := --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 \
	--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1

# The public surface: what changes here is in the changelog.
PUBLIC := r2s r2s.fabric r2s.family r2s.presets r2s.units r2s.mesh r2s.scene r2s.solver r2s.cloth \
	r2s.layers r2s.mpm r2s.scenario r2s.scenarios r2s.trajectories r2s.sweep \
	r2s.physics.membrane r2s.physics.plate r2s.physics.bending r2s.physics.table r2s.physics.solid \
	r2s.physics.air r2s.physics.contact r2s.recording r2s.manifest r2s.synthetic r2s.metrics r2s.losses \
	r2s.estimators.problem r2s.estimators.hanging r2s.estimators.estimate r2s.estimators.descent r2s.estimators.diffcloud \
	r2s.estimators.diffcp r2s.estimators.physnet r2s.estimators.pinn r2s.estimators.pinn_clouds \
	r2s.estimators.cma_es r2s.estimators.trust r2s.estimators.planned r2s.cards r2s.export r2s.gradcheck r2s.arcsim r2s.study.placement \
	r2s.interactive.subject r2s.interactive.page

.PHONY: study test test-slow lint types check docs clean

study: $(STAMP)
	$(RUN) experiments/study.py --preset $(PRESET) $(if $(DATA),--data "$(DATA)") --out "$(OUT)" \
		--workers $(WORKERS) $(ARGS)

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

docs: $(STAMP)
	$(RUN) -m pdoc --output-directory docs/api $(PUBLIC)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q --disable-pip-version-check -c constraints.txt -e ".[study,pcd,camera,data,cli,physnet,cma,cluster,viz,dev]"
	touch $@

clean:
	rm -rf $(VENV) results
