# Every target sets up what it needs on a fresh machine: git, make and Python 3.11 are enough.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
DATA ?= ../shared/data/withwithout
READY := $(VENV)/.ready

.PHONY: setup demo test test-all test-blenders test-painters lint bench bench-raster bench-surface bench-poisson bench-depth bench-propagate \
	bench-harmonics bench-nnf bench-inpaint bench-fill bench-fill-rules bench-pareto bench-stability bench-large bench-references bench-real bench-light bench-light-rules bench-faults fuzz extension \
	screenshots by-mouse clean
.DELETE_ON_ERROR:

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) not found; install Python 3.11 or give PYTHON=…" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[blender,evaluate,torch,dev]'
	@touch $@

demo: $(READY)
	$(BIN)/python scripts/demo.py

# a file's tests stay together: they share scenes and removals
SIDE_BY_SIDE := -n 2 --dist loadfile

test: $(READY)
	$(BIN)/python -m pytest -m "not slow" $(SIDE_BY_SIDE)

# property tests at random, with five times as many examples
test-all: export HYPOTHESIS_PROFILE = thorough
test-all: $(READY) lint
	$(BIN)/python -m pytest
	$(BIN)/python scripts/test_blenders.py

# the add-on's tests under Blender 4.5 LTS and 5.2 LTS
test-blenders: $(READY)
	$(BIN)/python scripts/test_blenders.py

# the painters with their optional libraries, ONNX Runtime and Google's client, in an environment of their own
PAINTERS := build/painters

$(PAINTERS)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(PAINTERS)
	$(PAINTERS)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[torch,onnx,gemini,dev]'
	@touch $@

test-painters: $(PAINTERS)/.ready
	$(PAINTERS)/bin/python -m pytest tests/core/priors tests/e2e/test_painters.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: bench-raster bench-surface bench-poisson bench-depth bench-propagate bench-harmonics bench-nnf bench-inpaint \
	bench-pareto bench-stability
	$(BIN)/gimp3d bench $(DATA) --scenes desk,corner,gloss,rocks --presets draft,balanced,best --out build/bench

# PROTOTYPE=folder: also against the rasteriser's first prototype
bench-raster: $(READY)
	$(BIN)/python scripts/bench_raster.py $(if $(PROTOTYPE),--prototype $(PROTOTYPE))

bench-surface: $(READY)
	$(BIN)/python scripts/bench_surface.py $(DATA)

bench-poisson: $(READY)
	$(BIN)/python scripts/bench_poisson.py

bench-depth: $(READY)
	$(BIN)/python scripts/bench_depth.py --data $(DATA)

bench-propagate: $(READY)
	$(BIN)/python scripts/bench_propagate.py $(DATA)

# 128 removals: an hour, so not part of bench
bench-references: $(READY)
	$(BIN)/python scripts/bench_references.py $(DATA)

# every preset on real scenes, with the true picture and without, and the paper's: an hour or more, so not part of bench
bench-real: $(READY)
	$(BIN)/python scripts/bench_real.py $(DATA)

bench-light: $(READY)
	$(BIN)/python scripts/bench_light.py $(DATA)

bench-light-rules: $(READY)
	$(BIN)/python scripts/light_ablation.py $(DATA)

# with DATA, also what the fit brings to removals: ten minutes more
bench-harmonics: $(READY)
	$(BIN)/python scripts/bench_harmonics.py $(if $(wildcard $(DATA)),--data $(DATA))

# presets, ablations and baselines: half an hour
bench-pareto: $(READY)
	$(BIN)/python scripts/bench_refine.py $(DATA)

# removals whose input is wrong: ten minutes
bench-stability: $(READY)
	$(BIN)/python scripts/bench_stability.py $(DATA)

# desk with every Gaussian split in ten and 200 views of 960 × 540
bench-large: $(READY)
	$(BIN)/python scripts/bench_large.py $(DATA)/desk

# bad inputs, faults, kills and moved scenes: the table of docs/reliability.md, in less than half an hour
bench-faults: $(READY)
	$(BIN)/python scripts/bench_faults.py

# changed files for every reader, guided by coverage where atheris can be installed: hours; goes on where it stopped
FUZZ := build/fuzz/venv

$(FUZZ)/.ready: $(READY)
	$(BIN)/python -m venv $(FUZZ)
	echo "import site; site.addsitedir('$(CURDIR)/$(VENV)/lib/python3.11/site-packages')" > \
		$$($(FUZZ)/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/project.pth
	$(FUZZ)/bin/python -m pip install --quiet atheris==3.0.0 || echo "atheris cannot be installed here; cases are made by number"
	@touch $@

fuzz: $(FUZZ)/.ready
	$(FUZZ)/bin/python scripts/fuzz.py

# scikit-image's photographs and other programs' fills come from an environment of their own
OTHERS := build/others

$(OTHERS)/.ready:
	$(PYTHON) -m venv $(OTHERS)
	$(OTHERS)/bin/python -m pip install --quiet 'numpy<2' scikit-image==0.26.0 imageio
	$(OTHERS)/bin/python -m pip install --quiet PyPatchMatch==2.2.0 || echo "PyPatchMatch cannot be installed here; it is left out"
	@touch $@

bench-nnf: $(READY) $(OTHERS)/.ready
	$(BIN)/python scripts/bench_nnf.py --others $(OTHERS)/bin/python

bench-inpaint: $(READY) $(OTHERS)/.ready
	$(BIN)/python scripts/bench_inpaint.py --others $(OTHERS)/bin/python

# the built-in fill beside the true picture given, and beside other programs on pictures with structure: ten minutes
bench-fill: $(READY) $(OTHERS)/.ready
	$(BIN)/python scripts/bench_fill.py $(DATA) --others $(OTHERS)/bin/python

bench-fill-rules: $(READY)
	$(BIN)/python scripts/fill_ablation.py $(DATA)

extension: $(READY)
	$(BIN)/python scripts/build_extension.py

# in a real Blender with its window, on a virtual screen: root on Debian, see scripts/screenshots.py
screenshots: demo
	cp build/demo/before_after.png assets/before_after.png
	$(BIN)/python scripts/screenshots.py

# a removal by mouse, by script and by command in a real Blender gives the same bytes: needs what screenshots needs
by-mouse: $(READY)
	$(BIN)/python scripts/by_mouse.py
	$(BIN)/python scripts/by_mouse.py --suite sid

clean:
	rm -rf build dist $(VENV)
