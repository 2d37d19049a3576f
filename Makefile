# Every target sets up what it needs on a fresh machine: git, make and Python 3.11 are enough.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
DATA ?= ../shared/data/withwithout
READY := $(VENV)/.ready

.PHONY: setup demo test test-all test-blenders test-painters lint bench bench-raster bench-poisson \
	bench-ablation bench-propagate bench-inpaint bench-fill bench-fill-rules bench-pareto bench-stability \
	bench-large bench-real bench-boxes bench-light bench-light-rules bench-faults fuzz extension screenshots by-mouse clean scenes
.DELETE_ON_ERROR:

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) not found; install Python 3.11 or give PYTHON=…" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[blender,evaluate,torch,dev]'
	@touch $@

demo: $(READY)
	$(BIN)/python tools/demo.py

# a file's tests stay together: they share scenes and removals
SIDE_BY_SIDE := -n 2 --dist loadfile

test: $(READY)
	$(BIN)/python -m pytest -m "not slow" $(SIDE_BY_SIDE)

# property tests at random, with five times as many examples
test-all: export HYPOTHESIS_PROFILE = thorough
test-all: $(READY) lint
	$(BIN)/python -m pytest
	$(BIN)/python tools/test_blenders.py

# the add-on's tests under Blender 4.5 LTS and 5.2 LTS
test-blenders: $(READY)
	$(BIN)/python tools/test_blenders.py

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

bench: bench-raster bench-poisson bench-inpaint bench-pareto bench-stability
	$(BIN)/gimp3d bench $(DATA) --scenes desk,corner,gloss,rocks --presets draft,balanced,best --out build/bench

bench-raster: $(READY)
	$(BIN)/python -m benchmarks.raster

bench-poisson: $(READY)
	$(BIN)/python -m benchmarks.poisson

# each rule of a removal switched off in turn: hours, so not part of bench; goes on where it stopped
bench-ablation: $(READY)
	$(BIN)/python -m benchmarks.ablation $(DATA)

# those of the way from the reference into the other views
bench-propagate: $(READY)
	$(BIN)/python -m benchmarks.ablation $(DATA) --out build/bench_propagate \
		--rules "the warp" "paper's sampling" "paper's blend"

# every preset on real scenes, with the true picture and without, and the paper's: an hour or more, so not part of bench
bench-real: $(READY)
	$(BIN)/python -m benchmarks.real $(DATA)

# eight further scenes with truth, rendered and trained: three quarters of an hour; then e.g. make bench-ablation DATA=build/made
scenes: $(READY)
	$(BIN)/python tools/make_scenes.py

# removals in boxes that other users would draw: half an hour, goes on where it stopped
bench-boxes: $(READY)
	$(BIN)/python -m benchmarks.boxes $(DATA)

bench-light: $(READY)
	$(BIN)/python -m benchmarks.light $(DATA)

# one of the rules about the object's light switched off: make bench-light-rules RULE="hue is no paint"
bench-light-rules: $(READY)
	$(BIN)/python -m benchmarks.light $(DATA) --skip-removals --without "$(or $(RULE),a light need not beat chance)"

# presets, ablations and baselines: half an hour
bench-pareto: $(READY)
	$(BIN)/python -m benchmarks.pareto $(DATA)

# removals whose input is wrong: ten minutes
bench-stability: $(READY)
	$(BIN)/python -m benchmarks.stability $(DATA)

# desk with every Gaussian split in ten and 200 views of 960 × 540
bench-large: $(READY)
	$(BIN)/python -m benchmarks.large $(DATA)/desk

# bad inputs, faults, kills and moved scenes: the table of docs/reliability.md, in less than half an hour
bench-faults: $(READY)
	$(BIN)/python -m benchmarks.faults

# changed files for every reader, guided by coverage where atheris can be installed: hours; goes on where it stopped
FUZZ := build/fuzz/venv

$(FUZZ)/.ready: $(READY)
	$(BIN)/python -m venv $(FUZZ)
	echo "import site; site.addsitedir('$(CURDIR)/$(VENV)/lib/python3.11/site-packages')" > \
		$$($(FUZZ)/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/project.pth
	$(FUZZ)/bin/python -m pip install --quiet atheris==3.0.0 || echo "atheris cannot be installed here; cases are made by number"
	@touch $@

fuzz: $(FUZZ)/.ready
	$(FUZZ)/bin/python tools/fuzz.py

# scikit-image's photographs and other programs' fills come from an environment of their own
OTHERS := build/others

$(OTHERS)/.ready:
	$(PYTHON) -m venv $(OTHERS)
	$(OTHERS)/bin/python -m pip install --quiet 'numpy<2' scikit-image==0.26.0 imageio
	$(OTHERS)/bin/python -m pip install --quiet PyPatchMatch==2.2.0 || echo "PyPatchMatch cannot be installed here; it is left out"
	@touch $@

bench-inpaint: $(READY) $(OTHERS)/.ready
	$(BIN)/python -m benchmarks.fill --only photographs --out build/bench_inpaint --others $(OTHERS)/bin/python

# the built-in fill beside the true picture given, and beside other programs on pictures with structure: ten minutes
bench-fill: $(READY) $(OTHERS)/.ready
	$(BIN)/python -m benchmarks.fill --only pictures --others $(OTHERS)/bin/python
	$(BIN)/python -m benchmarks.real $(DATA) --presets balanced --out build/bench_fill \
		--scenes desk,corner,gloss,rocks,real_table,real_bed,kitchen_monkey,tiles_mug

# those of the fill: whole removals without a picture given
bench-fill-rules: $(READY)
	$(BIN)/python -m benchmarks.ablation $(DATA) --rules regular vote "Telea" --picture built-in --out build/bench_fill_rules

extension: $(READY)
	$(BIN)/python tools/build_extension.py

# in a real Blender with its window, on a virtual screen: root on Debian, see tools/screenshots.py
screenshots: demo
	cp build/demo/before_after.png assets/before_after.png
	$(BIN)/python tools/screenshots.py

# a removal by mouse, by script and by command in a real Blender gives the same bytes: needs what screenshots needs
by-mouse: $(READY)
	$(BIN)/python tools/by_mouse.py
	$(BIN)/python tools/by_mouse.py --suite sid

clean:
	rm -rf build dist $(VENV)
