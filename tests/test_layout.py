"""The names that Python, the README and the Makefile rely on."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from pipelines.cli import parser
from pipelines.options import compose
from pipelines.plugins import declared
from pipelines.request import read_settings
from sync.capture import CaptureSettings
from tests.support.places import ROOT

PACKAGES = ("bench", "pipelines", "tasks", "packuv", "sync", "calibration", "studio")


@pytest.mark.parametrize("package", PACKAGES)
def test_package_names_resolve_to_this_checkout(package):
    found = Path(importlib.import_module(package).__file__ or "").resolve()
    assert found.is_relative_to(ROOT), (
        f"{package} is imported from {found}; install this checkout with pip install -e ."
    )


@pytest.mark.parametrize("folder", ["tasks", "pipelines"])
def test_no_module_hides_a_package(folder):
    names = {path.stem for path in (ROOT / folder).glob("*.py")}
    assert not names & {*PACKAGES, "docker", "examples", "tests"}


def _commands(text: str) -> list[list[str]]:
    """Lines that call packuv, with continuation lines joined, without the remark after two spaces or a #."""
    lines = text.replace("\\\n", " ").splitlines()
    found = [re.search(r"(?:^|/|\s)packuv (.*)", re.split(r" {2,}| #", line.strip())[0]) for line in lines]
    return [shlex.split(match[1]) for match in found if match]


def _is_example(words: list[str]) -> bool:
    """A command with real values; grammars use brackets and alternatives."""
    return not any(mark in word for word in words for mark in "[]<>|…")


@pytest.mark.parametrize("file", ["Makefile", "README.md", *(f"docs/{path.name}" for path in ROOT.glob("docs/*.md"))])
def test_documented_commands_exist(file):
    path = ROOT / file
    blocks = re.findall(r"(?m)^(?: {4}|\t).*$", path.read_text())
    grammar = parser(declared())  # whatever is installed
    commands = [words for words in _commands("\n".join(blocks)) if words and _is_example(words)]
    for words in commands:
        arguments = grammar.parse_args(words)  # raises UsageError for an unknown command or option
        if arguments.command == "run":
            compose("draft", CaptureSettings(), read_settings(None, arguments.set))
    assert commands or file.startswith("docs/")


def test_make_targets_that_the_readme_names_exist():
    targets = set(re.findall(r"(?m)^([a-z][a-z-]*):", (ROOT / "Makefile").read_text()))
    named = set(re.findall(r"(?m)^    make ([a-z][a-z-]*)", (ROOT / "README.md").read_text()))
    assert named <= targets


TEST_FILES = sorted(path.relative_to(ROOT / "tests") for path in ROOT.glob("tests/**/test_*.py"))


@pytest.mark.parametrize("file", TEST_FILES, ids=str)
def test_tests_mirror_the_rooms(file):
    """tests/packuv/fit/test_solver.py tests packuv/fit; tests of the whole lie in tests/, of the tests in support/."""
    whole = file.parent in (Path("."), Path("support"))
    assert whole or any((ROOT / file.parent).glob("*.py")), f"there is no room {file.parent} that tests/{file} is for"


def test_every_helper_of_the_tests_has_its_place():
    """Beside tests lie conftest.py alone; what they share is in support/, and no folder is a package."""
    others = [path for path in ROOT.glob("tests/**/*.py") if not path.name.startswith("test_")]
    misplaced = [path for path in others if path.name != "conftest.py" and path.parent != ROOT / "tests/support"]
    assert not misplaced
