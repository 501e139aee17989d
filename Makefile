# The two commands a newcomer needs are `make demo` and `make test`; both set everything up first.
PYTHON ?= python3.11
# On a machine whose index serves CUDA builds of torch first, a CPU-only set-up is:
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
# More arguments of pytest: make test PYTEST='--cov -k scene'
PYTEST ?=
# Files of tests that run at once.
WORKERS ?= 2
SIDE_BY_SIDE = -n $(WORKERS) --dist loadfile --no-loadscope-reorder
BIN := .venv/bin
READY := .venv/.ready

# Each job of a run is a process of its own: where none may keep bytecode, all compile our modules anew (0.4 s).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo pictures test test-fast check gpu setup clean

demo: $(READY)
	$(BIN)/packuv simulate runs/demo/capture --cameras 8 --frames 24 --size 320x180 --seed 7 --rig front
	$(BIN)/packuv run runs/demo/capture --out runs/demo --preset draft \
		--set fit.iterations=1800 --set fit.key_iterations=800 --set fit.density.cap=30000

# The pictures of README and docs, and the scene in examples/, of the demo; Chromium must be on the PATH.
pictures: $(READY)
	test -f runs/demo/studio/report.html || $(MAKE) demo
	$(BIN)/python -m tests.support.gallery runs/demo/studio

test: $(READY)
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) $(PYTEST)

test-fast: $(READY)
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not slow"

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# What a GPU does and how fast, within nine minutes; bench/gpu.sh runs by itself where nothing is set up.
gpu: $(READY)
	OUT=$${OUT:-runs/gpu} PYTHON=$(BIN)/python bench/gpu.sh

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "PackUV needs Python 3.11; '$(PYTHON)' is not on the PATH. Set PYTHON=/path/to/python3.11."; exit 2; }
	@command -v ffmpeg >/dev/null || { [ "$$(id -u)" = 0 ] && apt-get update -qq && apt-get install -y -qq ffmpeg; } \
	  || { echo "PackUV needs the system package ffmpeg (torchcodec loads its libraries): sudo apt-get install ffmpeg"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -q -c constraints.txt torch $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX))
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf .venv runs build *.egg-info
