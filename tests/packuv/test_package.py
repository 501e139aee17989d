"""What `import packuv` gives."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import tomllib

import pytest

import packuv
from pipelines.cli import main
from tests.support.places import ROOT

DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_version_is_what_is_installed():
    assert packuv.__version__ == importlib.metadata.version("packuv")


def test_version_of_a_checkout_that_is_not_installed(monkeypatch):
    def version(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert packuv.__version__ == DECLARED


def test_the_command_tells_the_version(capsys):
    with pytest.raises(SystemExit) as leaving:
        main(["--version"])
    assert leaving.value.code == 0
    assert capsys.readouterr().out == f"packuv {packuv.__version__}\n"


def test_every_name_is_there_and_open_is_an_alias():
    assert all(hasattr(packuv, name) for name in packuv.__all__)
    assert packuv.open is packuv.open_scene
    with pytest.raises(AttributeError, match="module 'packuv' has no attribute 'frob'"):
        _ = packuv.frob


def test_importing_it_imports_nothing_heavy():
    code = "import sys, packuv; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "torch", "numba", "av", "importlib.metadata"} & set(modules)
