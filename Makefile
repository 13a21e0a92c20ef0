# make study [PRESET=name] [DATA=folder] [OUT=folder] [WORKERS=number] [ARGS=...], make test, make
# test-slow [GROUP=name], make test-annotations, make check, make docs: each sets up what it needs.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
RUN := $(VENV)/bin/python
DATA ?=
OUT ?= results
ARGS ?=
PRESET ?= one_fabric
WORKERS ?= 2
# What takes longer than a second or two: `make test-slow GROUP=cloth` runs one group, `make
# test-slow` all of them.
GROUPS := cloth mpm motions estimates arrival pinn physnet study verdicts documents
# Slow tests check the shapes in annotations as they run, which takes half as long again; so do the
# fast tests by `make test-annotations`.
TYPED := --jaxtyping-packages=r2s,beartype.beartype
GROUP :=

# Most of the fast tests' time is compilation: they do without XLA's optimisation. Two processes of
# one thread each: threads that wait for each other cost more than they compute, those of OpenBLAS
# twice as much as all the rest. A program that is read from a file makes XLA complain of features
# of the machine that it made up: it is silenced.
ALONE := OMP_NUM_THREADS=1 NPROC=1 TF_CPP_MIN_LOG_LEVEL=3
QUICK := --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0

# Documented by `make docs`: the public surface, `import r2s`, then the rooms below it.
MODULES := r2s $(filter-out r2s.__init__,$(subst /,.,$(basename \
	$(wildcard r2s/*.py) $(patsubst %/__init__.py,%.py,$(wildcard r2s/*/__init__.py)))))

.PHONY: study test test-annotations test-slow $(addprefix test-slow-,$(GROUPS)) lint types check docs clean

study: $(STAMP)
	$(RUN) -m r2s study --preset $(PRESET) $(if $(DATA),--data "$(DATA)") --out "$(OUT)" \
		--workers $(WORKERS) $(ARGS)

FAST = $(ALONE) XLA_FLAGS="$(QUICK)" $(RUN) -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(FAST)

test-annotations: $(STAMP)
	$(FAST) $(TYPED)

test-slow: $(if $(GROUP),test-slow-$(GROUP),$(addprefix test-slow-,$(GROUPS)))

$(addprefix test-slow-,$(GROUPS)): test-slow-%: $(STAMP)
	$(ALONE) $(RUN) -m pytest -q -n 2 $(TYPED) --dist worksteal --durations=5 \
		-m "slow(group='$*')"

lint: $(STAMP)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

types: $(STAMP)
	$(RUN) -m pyright

check: lint types

docs: $(STAMP)
	$(RUN) -m pdoc --output-directory docs/api $(MODULES)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q --disable-pip-version-check -c constraints.txt -e ".[study,pcd,camera,data,cli,physnet,pinn,laboratory,cma,cluster,viz,mujoco,dev]"
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache results
