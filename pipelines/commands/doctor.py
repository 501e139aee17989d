"""`packuv doctor`: what this machine has and lacks."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from pipelines.commands.output import answer
from pipelines.disk import size_text


def doctor(arguments: argparse.Namespace) -> int:
    """`packuv doctor`: exit code 1 if something is missing that every run needs."""
    found = list(_examine())
    for name, state, needed in found:
        answer(f"{'ok' if state[0] else 'MISSING' if needed else 'absent':<8} {name:<12} {state[1]}")
    return 0 if all(state[0] or not needed for _, state, needed in found) else 1


def _examine() -> Iterator[tuple[str, tuple[bool, str], bool]]:
    """What, whether and in which version it is there, and whether runs need it."""
    yield "python", (sys.version_info >= (3, 11), platform.python_version()), True
    yield "cores", (True, f"{len(os.sched_getaffinity(0))}"), True
    yield "memory", _memory(), True
    disk = shutil.disk_usage(Path.cwd())
    yield "disk", (disk.free > 2**30, f"{size_text(disk.free)} free here"), True
    yield "ffmpeg", _ffmpeg(), True
    for name in ("numpy", "numba", "torch", "torchcodec", "cv2", "av", "pyarrow", "prefect"):
        yield name, _module(name), True
    yield "pycolmap", _module("pycolmap"), False
    yield "gpu", _gpu(), False
    yield "fit on gpu", _fit_on_gpu(), False


def _memory() -> tuple[bool, str]:
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return total > 3 * 2**30, size_text(total)


def _ffmpeg() -> tuple[bool, str]:
    path = shutil.which("ffmpeg")
    return path is not None, path or "not on the PATH; torchcodec loads its libraries: apt-get install ffmpeg"


def _module(name: str) -> tuple[bool, str]:
    try:
        module = importlib.import_module(name)
    except Exception as error:
        return False, f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error) else ''}"
    return True, str(getattr(module, "__version__", "there"))


def _fit_on_gpu() -> tuple[bool, str]:
    try:
        from packuv.fit.device import obstacle
    except ImportError as error:
        return False, str(error)
    problem = obstacle()
    return problem is None, problem or "the GPU draws what the CPU draws"


def _gpu() -> tuple[bool, str]:
    if (query := shutil.which("nvidia-smi")) is None:
        return False, "no NVIDIA driver; the CPU does everything"
    command = [query, "--query-gpu=name,memory.total,memory.free", "--format=csv,noheader,nounits"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if answer.returncode:
        return False, (answer.stdout.strip().splitlines() or ["a driver, but no GPU"])[0]
    found = "; ".join(_gpu_text(*line.rsplit(", ", 2)) for line in answer.stdout.splitlines())
    return bool(found), found or "a driver, but no GPU"


def _gpu_text(name: str, total_mib: str, free_mib: str) -> str:
    if not (total_mib.isdigit() and free_mib.isdigit()):  # of memory that is the CPU's the driver does not tell
        return name
    total, free = (size_text(int(mib) * 2**20) for mib in (total_mib, free_mib))
    return f"{name}: {total} of memory, {free} of them free"
