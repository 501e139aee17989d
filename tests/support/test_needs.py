"""The switch that turns skips into failures."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.needs import KINDS, VARIABLE, need
from tests.support.places import ROOT

CONFTEST = """
from tests.conftest import pytest_configure, pytest_runtest_setup
"""
TESTS = """
import pytest
from tests.support.needs import need, needs

@needs("cuda", False, "no card")
def test_marked():
    raise AssertionError("must not run")

@needs("cuda", True, "no card")
def test_found():
    pass

@pytest.fixture
def browser():
    need("chromium", None, "no browser")

def test_fixture(browser):
    raise AssertionError("must not run")
"""


def outcomes(folder: Path, switch: str) -> tuple[int, str]:
    """Exit code and output of a run of TESTS under a value of PACKUV_REQUIRE."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_made_up.py").write_text(TESTS)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = need: ...\n")
    environment = {**os.environ, VARIABLE: switch, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-rsf", "-p", "no:cacheprovider", "--strict-markers", str(folder)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=100)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("switch", "code", "counts"),
    [
        ("", 0, {"passed": 1, "skipped": 2}),
        ("data,ffmpeg", 0, {"passed": 1, "skipped": 2}),
        ("cuda", 1, {"failed": 0, "error": 1, "passed": 1, "skipped": 1}),
        ("cuda, chromium", 1, {"passed": 1, "error": 2}),
    ],
)
def test_promised_kinds_fail_and_others_skip(tmp_path, switch, code, counts):
    found, output = outcomes(tmp_path, switch)
    assert found == code, output
    for what, count in counts.items():
        number = re.search(rf"(\d+) {what}", output.splitlines()[-1])
        assert (int(number[1]) if number else 0) == count, output
    assert ("promises cuda, but: no card" in output) == ("cuda" in switch)


def test_an_unknown_kind_is_an_error(tmp_path):
    code, output = outcomes(tmp_path, "cuda,crome")
    assert code == pytest.ExitCode.USAGE_ERROR
    assert f"PACKUV_REQUIRE names some of {', '.join(KINDS)}, but also crome" in output
    with pytest.raises(ValueError, match="not crome"):
        need("crome", True, "")


def test_nothing_else_skips():
    """A skip for any other reason is a test that could not fail."""
    ways = re.compile(r"pytest\.(?:skip|importorskip)\(|mark\.(?:skip|skipif|xfail)\b")
    files = [path for path in ROOT.glob("tests/**/*.py") if path.name not in ("needs.py", Path(__file__).name)]
    assert not [str(path.relative_to(ROOT)) for path in files if ways.search(path.read_text())]
