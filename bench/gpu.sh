#!/bin/sh
# All that a GPU can tell, within nine minutes: bench/gpu.py, with Python 3.12 (or 3.11), torch, numba, numba-cuda and numpy.
#   OUT=results PYTHON=python3 bench/gpu.sh [--toy]
set -eu
cd "$(dirname "$0")/.."
exec timeout 540 "${PYTHON:-python3}" -u -m bench.bare bench.gpu --out "${OUT:-runs/gpu}" "$@"
