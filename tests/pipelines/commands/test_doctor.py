"""What `packuv doctor` says of a GPU, by a driver's program that is made up."""

from __future__ import annotations

import pytest

from pipelines.commands import doctor


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("NVIDIA H200, 143771, 140000", "NVIDIA H200: 150.8 GB of memory, 146.8 GB of them free"),
        (
            "A, 8192, 8000\nB, 4096, 0",
            "A: 8.6 GB of memory, 8.4 GB of them free; B: 4.3 GB of memory, 0 B of them free",
        ),
        ("NVIDIA GB10, [N/A], [N/A]", "NVIDIA GB10"),
        ("", "a driver, but no GPU"),
    ],
    ids=["one", "two", "memory of the CPU", "none"],
)
def test_a_gpu_is_named_with_its_memory(tmp_path, monkeypatch, lines, told):
    program = tmp_path / "nvidia-smi"
    asked = "--query-gpu=name,memory.total,memory.free --format=csv,noheader,nounits"
    program.write_text(f'#!/bin/sh\n[ "$*" = "{asked}" ] && printf "{lines}"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor._gpu() == (bool(lines), told)


@pytest.mark.parametrize(
    ("said", "told"), [("No devices were found", "No devices were found"), ("", "a driver, but no GPU")]
)
def test_a_driver_that_finds_no_gpu_is_believed(tmp_path, monkeypatch, said, told):
    """It says so where the figures would be."""
    program = tmp_path / "nvidia-smi"
    program.write_text(f'#!/bin/sh\necho "{said}"\nexit 6\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor._gpu() == (False, told)


def test_without_a_driver_the_cpu_does_everything(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor._gpu() == (False, "no NVIDIA driver; the CPU does everything")
