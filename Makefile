# Everything one does with this project; `make help` lists it. Two commands for a newcomer: `make demo` and `make test`;
# each sets up what it needs.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# What to install as PyTorch. For a build from one of PyTorch's own indexes (CPU only, another CUDA) set pip's
# environment, e.g. PIP_EXTRA_INDEX_URL, and name the build here: make setup TORCH=torch==2.13.0+cpu
TORCH ?= torch==2.13.0
# What installs all but PyTorch. CI takes uv, which is twice as fast; PyTorch always comes by pip, whose settings say
# which build.
INSTALL ?= $(BIN)/python -m pip install
# Test processes. Each computes on one thread, so that they share the cores instead of fighting over them.
WORKERS ?= 2
# More words for pytest: make test PYTEST_ARGS="--cpu-seconds=seconds.json" writes where the processor seconds go.
PYTEST_ARGS ?=
SEED ?= 0
DEMO_DATA ?= datasets/mujoco_block_demo
DEMO_RUN ?= runs/demo/seed$(SEED)
STAMP := $(VENV)/.installed

export MPLBACKEND = Agg

.PHONY: edit-data test-kernels test-benchmarks test-reliability test-documents pages view editing-figure novel-view-figure audit reliability help setup install demo generate-demo train-demo eval-demo video-demo test test-parts test-exhaustive test-data test-site test-package test-launchers test-browser test-fast check format format-check lint \
	types imports docs cluster bench stability paper-step wheel clean

help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  %-17s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	echo
	echo "Variables: PYTHON=$(PYTHON) TORCH=$(TORCH) WORKERS=$(WORKERS) SEED=$(SEED)"

setup: $(STAMP) ## Make .venv and install the project with its tested versions (TORCH=... picks a PyTorch build)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; assert (3, 11) <= sys.version_info[:2] <= (3, 13), f"Python 3.11 to 3.13 is needed, this is {sys.version.split()[0]}: make setup PYTHON=python3.12"'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt "$(TORCH)"
	$(INSTALL) -c constraints.txt -e ".[dev]"
	touch $@

install: ## Install the project into the environment that is active now, without a .venv
	$(PYTHON) -m pip install -c constraints.txt "$(TORCH)"
	$(PYTHON) -m pip install -c constraints.txt -e .

demo: setup ## Generate, train, evaluate and film the two-core demo (about 10 minutes); its figures come last
	$(MAKE) --no-print-directory generate-demo
	$(MAKE) --no-print-directory train-demo
	$(MAKE) --no-print-directory video-demo
	$(MAKE) --no-print-directory eval-demo

generate-demo: $(STAMP) ## Generate the demo's videos with MuJoCo (resumes, or does nothing when they are there)
	$(BIN)/vpd-data generate scene=mujoco_block preset=demo out=$(DEMO_DATA) seed=0

train-demo: $(STAMP) ## Train the demo (SEED=0); a stopped training goes on where it was
	$(BIN)/vpd-train experiment=demo seed=$(SEED) data.folder=$(DEMO_DATA) run.folder=$(DEMO_RUN) resume=auto

# Results are never overwritten: a second evaluation or film of the same run gets a folder with the time in its name.
NEW_FOLDER = $$(test -e $(1) && echo $(1)_$$(date +%Y-%m-%d_%H-%M-%S) || echo $(1))

eval-demo: $(STAMP) ## Evaluate the demo on its test trajectories and print the figures
	$(BIN)/vpd-eval ckpt=$(DEMO_RUN)/checkpoints/last.ckpt data.folder=$(DEMO_DATA) out=$(call NEW_FOLDER,$(DEMO_RUN)/evaluation)

video-demo: $(STAMP) ## Film a predicted rollout of the demo
	$(BIN)/vpd-render ckpt=$(DEMO_RUN)/checkpoints/last.ckpt data.folder=$(DEMO_DATA) out=$(call NEW_FOLDER,$(DEMO_RUN)/render)

VIEW_MODEL ?= released/mujoco_block_demo
view: $(STAMP) ## Open the browser viewer on a trained model (VIEW_MODEL=released/mujoco_block_demo)
	$(BIN)/vpd-view ckpt=$(VIEW_MODEL)

EDIT_DATA ?= datasets/deformable_collision_few
EDIT_MODEL ?= released/deformable_collision_128
edit-data: $(STAMP)
	$(BIN)/vpd-data generate scene=deformable_collision preset=paper splits.train=2 splits.validation=1 splits.test=4 out=$(EDIT_DATA) seed=0

editing-figure: edit-data ## Draw the paper's editing figure: without one body, the other, the floor (needs GL; 3 minutes)
	$(BIN)/python -m docs.results.studies.editing_figure $(EDIT_MODEL) --data $(EDIT_DATA) --start 8 --out $(call NEW_FOLDER,runs/editing_figure)

novel-view-figure: edit-data ## Draw the paper's novel-view figure: a ring of cameras after 8 steps, rendered and as particles
	$(BIN)/python -m docs.results.studies.novel_view_figure $(EDIT_MODEL) --data $(EDIT_DATA) --start 8 --out $(call NEW_FOLDER,runs/novel_view_figure)

# Bytecode is kept even where the environment says otherwise: without it each process compiles all modules and all tests.
PYTEST = PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest
PARALLEL = -n $(WORKERS) --dist loadfile --no-loadscope-reorder
# What has a target of its own: markers, and where the tests that have them lie.
PARTS = data or site or package or launcher or browser or documents or kernels or benchmarks or reliability
# The interpreter's matrix comes first: it takes longest, and no process should be left alone with it at the end.
PARTS_IN = tests/stability/test_interpreter_stability.py tests/data_gen tests/integration tests/commands/test_launchers.py tests/viewer \
	tests/test_site.py tests/test_packaging.py tests/documents tests/examples tests/renderer tests/graph tests/benchmarks tests/reliability

test: $(STAMP) ## Run the tests, but for the parts below; of the stability matrix a part that covers it (no GPU, no torch-cluster)
	$(PYTEST) $(PARALLEL) -m "not exhaustive and not ($(PARTS))" --durations=15 --durations-min=5 $(PYTEST_ARGS)

test-parts: $(STAMP) ## Run the nine parts below in one go
	$(PYTEST) $(PARALLEL) $(PARTS_IN) -m "not exhaustive and ($(PARTS))" --durations=15 --durations-min=5 $(PYTEST_ARGS)

test-data: $(STAMP) ## Test that data sets are generated and imported, and that each can be trained on (some need GL)
	$(PYTEST) $(PARALLEL) tests/data_gen tests/integration -m "not exhaustive and data"

test-site: $(STAMP) ## Test the pages of docs/ as a site, built strictly
	$(PYTEST) tests/test_site.py -m site

test-package: $(STAMP) ## Test the wheel and a plug-in, installed
	$(PYTEST) tests/test_packaging.py tests/integration -m package

test-launchers: $(STAMP) ## Test Hydra's launchers, which start a process for each run
	$(PYTEST) tests/commands/test_launchers.py -m launcher

test-browser: $(STAMP) ## Test the viewer in Chromium
	$(PYTEST) tests/viewer -m browser

test-documents: $(STAMP) ## Test the commands and the Python that README, docs and notebook hold, shrunk
	$(PYTEST) $(PARALLEL) tests/documents tests/examples -m documents

test-kernels: $(STAMP) ## Test the Triton kernels in Triton's interpreter, stability matrix included
	$(PYTEST) $(PARALLEL) tests/stability/test_interpreter_stability.py tests/renderer tests/graph -m "not exhaustive and kernels"

test-benchmarks: $(STAMP) ## Test that every benchmark suite runs and writes its files
	$(PYTEST) $(PARALLEL) tests/benchmarks -m benchmarks

test-reliability: $(STAMP) ## Test what make reliability tests, in small
	$(PYTEST) tests/reliability -m reliability

test-exhaustive: $(STAMP) ## Run what `make test` and `make test-parts` leave out: every case of the matrix, more seeds and scenes
	$(PYTEST) $(PARALLEL) -m exhaustive $(PYTEST_ARGS)

test-fast: $(STAMP) ## Run the tests that are not marked slow, without parts and stability matrix (under 2 minutes)
	$(PYTEST) -n $(WORKERS) --dist loadfile -m "not slow and not exhaustive and not ($(PARTS))" --ignore=tests/stability

pages: $(STAMP) ## Write the figures of the result files into README, docs and the cards of released models
	$(BIN)/python -m benchmarks.page

check: format-check lint types imports test test-parts ## Everything that must pass before a change goes in

format: $(STAMP) ## Rewrite the code in the house format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

format-check: $(STAMP) ## Check the format
	$(BIN)/ruff format --check .

lint: $(STAMP) ## Check style and docstrings
	$(BIN)/ruff check .

types: $(STAMP) ## Check the type annotations
	$(BIN)/mypy
	$(BIN)/mypy --explicit-package-bases docs/results/studies

imports: $(STAMP) ## Check that imports point one way (contracts in pyproject.toml)
	$(BIN)/lint-imports

docs: $(STAMP) ## Build the pages of docs/ as a site into site/ (open site/index.html); a warning fails it
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

cluster: $(STAMP) ## Build and install torch-cluster (needs a C++ compiler; 10 to 20 minutes on two cores)
	$(BIN)/python -m pip install -c constraints.txt setuptools wheel
	$(BIN)/python -m pip install -c constraints.txt --no-build-isolation torch-cluster==1.6.3

blender: ## Make .venv-blender for renderer=blender (Python 3.11, 1 GB; GPL-3, in an environment and a process of its own)
	python3.11 -m venv .venv-blender
	.venv-blender/bin/python -m pip install bpy==5.0.1 OpenEXR

# Trained models for the suites accuracy and rollout: those under runs/bench, where there are any.
BENCH_MODELS = $(wildcard runs/bench/*/checkpoints/last.ckpt)
comma := ,
empty :=

stability: $(STAMP) ## Run the whole numerical stability matrix; the last line counts its cases
	$(PYTEST) tests/stability -n $(WORKERS) --dist loadfile -q

reliability: $(STAMP) ## Kill, damage, mutate, requeue: every promise of docs/reliability.md, in under 40 minutes; writes its table
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.reliability
	$(BIN)/python -m benchmarks.page

audit: ## Ask pip-audit about the locked versions; fails where it cannot tell (needs an index that has advisories)
	test -x .venv-audit/bin/pip-audit || { $(PYTHON) -m venv .venv-audit && .venv-audit/bin/python -m pip install pip-audit; }
	.venv-audit/bin/pip-audit --strict --no-deps --disable-pip -r constraints.txt

bench: $(STAMP) ## Measure all suites on the CPU, one thread, in under 15 minutes; writes benchmarks/results and its page
	OMP_NUM_THREADS=1 $(BIN)/vpd-bench suite=all device=cpu "ckpt=[$(subst $(empty) $(empty),$(comma),$(strip $(BENCH_MODELS)))]"
	$(BIN)/python -m benchmarks.page

paper-step: $(STAMP) ## Take one training step at the paper's size, one clip on the CPU: finite gradients, time, peak memory
	$(BIN)/python -m benchmarks.paper_size_step --json benchmarks/results/paper_size_step_cpu.json

wheel: $(STAMP) ## Build the wheel into dist/
	$(BIN)/python -m build --wheel

clean: ## Remove caches and build products; runs, data sets and .venv stay
	rm -rf build dist site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
