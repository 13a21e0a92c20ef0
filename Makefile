# make study [PRESET=name] [DATA=folder] [OUT=folder] [WORKERS=number] [ARGS=...], make test, make
# test-slow [GROUP=name], make check, make docs: each sets up what it needs.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
RUN := $(VENV)/bin/python
DATA ?=
OUT ?= results
ARGS ?=
PRESET ?= small
WORKERS ?= 2
# What takes minutes: `make test-slow GROUP=cloth` runs one group, `make test-slow` all of them.
GROUPS := cloth points motions estimates pinn physnet study documents
GROUP :=

# Most of the fast tests' time is compilation: they do without XLA's optimisation. Two processes of
# one thread each: threads that wait for each other cost more than they compute.
QUICK := --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 \
	--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1

# The public surface: what changes here is in the changelog.
PUBLIC := r2s r2s.fabrics.fabric r2s.fabrics.parameters r2s.fabrics.presets r2s.units r2s.geometry.mesh r2s.world.scene r2s.solver r2s.cloth.cloth \
	r2s.cloth.self_contact.contacts r2s.mpm r2s.scenarios.scenario r2s.scenarios r2s.scenarios.paths r2s.sweep \
	r2s.laws.membrane r2s.laws.plate r2s.laws.bending r2s.laws.tables r2s.laws.solid \
	r2s.world.air r2s.world.contact r2s.recordings.recording r2s.recordings.manifest r2s.scenarios.synthetic r2s.evaluation.metrics r2s.evaluation.losses \
	r2s.estimation.problem r2s.estimation.initial_shape r2s.estimation.estimate r2s.estimation.descent r2s.estimation.diffcloud \
	r2s.estimation.diffcp r2s.estimation.physnet.estimator r2s.estimation.pinn.from_pulls r2s.estimation.pinn.from_clouds \
	r2s.estimation.cma_es r2s.estimation.identifiability r2s.estimation.experiment_design r2s.estimation.cards r2s.export r2s.gradient_check r2s.fabrics.arcsim r2s.evaluation.placement \
	r2s.viewer.subject r2s.viewer.page

.PHONY: study test test-slow $(addprefix test-slow-,$(GROUPS)) lint types check docs clean

study: $(STAMP)
	$(RUN) experiments/study.py --preset $(PRESET) $(if $(DATA),--data "$(DATA)") --out "$(OUT)" \
		--workers $(WORKERS) $(ARGS)

test: $(STAMP)
	XLA_FLAGS="$(QUICK)" $(RUN) -m pytest -q -n 2 --dist loadfile

test-slow: $(if $(GROUP),test-slow-$(GROUP),$(addprefix test-slow-,$(GROUPS)))

$(addprefix test-slow-,$(GROUPS)): test-slow-%: $(STAMP)
	$(RUN) -m pytest -q -n 2 --dist worksteal --durations=5 -m "slow(group='$*')"

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
	rm -rf $(VENV) .pytest_cache results
