# plenocli: `make demo` and `make test` need nothing but Python 3.11 or newer, make and a package index.
# Everything else: `make help`.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV ?= .venv
RUNS ?= runs
include pipelines/names.mk
BIN := $(abspath $(VENV))/bin
READY := $(VENV)/.ready
PIPELINE = +PATH="$(BIN):$$PATH" $(MAKE) --no-print-directory -f
# the demo takes all cores unless -j says how many
CORES := $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1)
ALL_CORES = $(if $(filter -j%,$(MAKEFLAGS)),,-j$(CORES))

.PHONY: help env requirements sbom demo test lint extremes honesty faults kills fuzz test-slow spatial spatial-250um mismatch spectral dslr colorchecker raw sweep trade dictionary bench-sparse bench-reconstruct tiny paper tradeoff bench-pif docs wheel clean

help: ## show these targets
	@awk -F':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-18s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

env: $(READY) ## make the environment in .venv: the files of requirements.txt, by their hashes

$(READY): pyproject.toml requirements.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "plenocli needs Python 3.11 or newer; say which: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	@echo "making the environment in $(VENV) (once, a few minutes)"
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@$(VENV)/bin/python -m compileall -q plenocli # as pip does: without, a start compiles it all where Python may not write
	@touch $@

# tools that must not be among what they look at
TOOLS := $(VENV)-tools
$(TOOLS)/.ready: constraints.txt
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt uv cyclonedx-bom
	@touch $@

requirements: $(TOOLS)/.ready ## requirements.txt anew: the hashes of all files of the versions in constraints.txt
	$(TOOLS)/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
	  --extra plot --extra fast --extra ml --extra dev -c constraints.txt pyproject.toml -o requirements.txt

sbom: $(READY) $(TOOLS)/.ready ## what the environment holds, with licences, as CycloneDX: dist/sbom.json
	@mkdir -p dist
	$(TOOLS)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --of JSON -o dist/sbom.json $(VENV)

demo: $(READY) ## both experiments at a small size, with pictures: runs/demo/report.html
	$(PIPELINE) pipelines/demo.mk $(ALL_CORES) RUN=$(RUNS)/demo

tiny: $(READY) ## every stage once on the smallest camera, in seconds
	$(PIPELINE) pipelines/spatial.mk RUN=$(RUNS)/tiny CONFIG=sample_configs/tiny.toml ITERATIONS=3 BATCH=256

test: $(READY) ## all tests but the slow ones, one process a core
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --dist worksteal

lint: $(READY) ## layout, lint and types of the code
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

extremes: $(READY) ## errors of the solvers against the condition of the matrix; cameras and captures at the edges
	$(BIN)/python pipelines/benchmarks/extremes.py --run $(RUNS)/extremes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m "" --campaign tests/inverse/test_extremes.py tests/faults/test_cameras.py

honesty: $(READY) ## 2,000 random cameras of all shapes at random accuracies, 300 lenslets off the axis, and many neighbours, against sums that share no code with the models (40 minutes on 2 cores)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m "" tests/forward/propagation/test_foreign_cameras.py

faults: $(READY) ## the fault campaigns in full: 10,000 damaged files, 3,200 kills, full disks, power cuts, lack of memory, bombs (under an hour on 2 cores)
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --dist worksteal -m "" --campaign --ignore tests/faults/test_cameras.py tests/faults

kills: $(READY) ## of these the kills alone: 400 of stages, sweeps, learning, make, results written together, and client, workers and scheduler of Dask
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --dist worksteal -m "" --campaign tests/faults/test_kills.py tests/faults/test_cluster_kills.py tests/faults/test_transactions.py

fuzz: $(READY) ## ten minutes of coverage-guided fuzzing of every reader; what breaks one stays in runs/fuzz
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[fuzz]'
	$(BIN)/python tests/faults/fuzz.py --seconds 600 --run $(RUNS)/fuzz

test-slow: $(READY) ## the slow tests too
	$(VENV)/bin/python -m pytest -m ""

spatial: $(READY) ## section 3-2 of the paper at full size: every reconstruction method in one table
	$(PIPELINE) pipelines/spatial.mk RUN=$(RUNS)/spatial CONFIG=sample_configs/seed_spatial.toml

spatial-250um: $(READY) ## the same with 250 um lenslets, f/4.4 and 4.8 um pixels
	$(PIPELINE) pipelines/spatial.mk RUN=$(RUNS)/spatial-250um CONFIG=sample_configs/seed_spatial_250um.toml

mismatch: $(READY) ## captures of cameras that are not as described, every method: table in runs/mismatch (SIZE=full: hours; SCENES=, FIT=)
	$(PIPELINE) pipelines/mismatch.mk RUN=$(RUNS)/mismatch

spectral: $(READY) ## section 3-1 of the paper, for an achromat and for a singlet: predicted and measured response, every estimator
	$(PIPELINE) pipelines/spectral.mk RUN=$(RUNS)/spectral/achromat CONFIG=sample_configs/seed_spectral.toml
	$(PIPELINE) pipelines/spectral.mk RUN=$(RUNS)/spectral/singlet CONFIG=sample_configs/seed_spectral_singlet.toml
	$(BIN)/plenocli report $(RUNS)/spectral -o $(RUNS)/spectral/report.html --overwrite

dslr: $(READY) ## the spectral experiment with a Bayer sensor
	$(PIPELINE) pipelines/spectral.mk RUN=$(RUNS)/dslr CONFIG=sample_configs/dslr.toml

colorchecker: $(READY) ## a real ColorChecker under narrow-band light against its spectrometer, and through the camera: make colorchecker DATA=folder
	@test -d "$(DATA)" || { echo "say where the captures are: make colorchecker DATA=folder" >&2; exit 2; }
	$(PIPELINE) pipelines/colorchecker.mk RUN=$(RUNS)/colorchecker DATA="$(DATA)"

raw: $(READY) ## calibrate and demultiplex your own captures: make raw WHITE=.. DARK=.. CAPTURES="a.nef b.nef"
	$(PIPELINE) pipelines/raw.mk RUN=$(RUNS)/raw

paper: $(READY) ## the paper's figures made anew, each with its statement, our number and a verdict: runs/paper/paper.html (DOLL=file)
	$(PIPELINE) pipelines/paper.mk $(ALL_CORES) RUN=$(RUNS)/paper $(DOLL:%=DOLL=%)

tradeoff: $(READY) ## what the accuracy dial promises and delivers, against brute force: a table and a plot (an hour; PLAN=1 says how long)
	$(PIPELINE) pipelines/tradeoff.mk RUN=$(RUNS)/tradeoff

sweep: $(READY) ## a design space in one command: the examples of sample_configs/sweeps, tables and fronts in runs/sweep
	$(PIPELINE) pipelines/sweep.mk RUN=$(RUNS)/sweep WORKERS=$(CORES)

trade: $(READY) ## what model, accuracy, neighbours, method and steps buy and cost, captures simulated finer: runs/trade/trade.html
	$(PIPELINE) pipelines/trade.mk RUN=$(RUNS)/trade WORKERS=$(CORES)

dictionary: $(READY) ## Algorithm 1 at the paper's size, 20 iterations: a line for each, the history as a plot
	$(PIPELINE) pipelines/dictionary.mk RUN=$(RUNS)/dictionary

bench-sparse: $(READY) ## sparse coding beside SPAMS, scikit-learn, FISTA and an interior-point method: time and gap of each
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python pipelines/benchmarks/sparse.py --run $(RUNS)/bench-sparse

bench-reconstruct: $(READY) ## every method of reconstruction at 60, 40, 30 and 20 dB, square and circular lenslets: quality and time of each
	$(BIN)/python pipelines/benchmarks/reconstruct.py --run $(RUNS)/bench-reconstruct

bench-pif: $(READY) ## the system matrix beside prysm, poppy, hcipy and LightPipes: time and error of each
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python pipelines/benchmarks/pif.py --run $(RUNS)/bench-pif

docs: $(READY) ## the pages of docs/ that come from the program: commands, file format
	$(BIN)/python pipelines/pages.py docs

# without build/, which keeps modules that have moved since
wheel: $(READY) ## one file that installs without the repository: dist/plenocli-VERSION-py3-none-any.whl
	rm -rf build
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation -w dist .
	rm -rf build

clean: ## remove results, keep the environment
	rm -rf $(RUNS)
