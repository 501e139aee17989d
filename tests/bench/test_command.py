"""`packuv bench`: a command that comes through an entry point."""

from __future__ import annotations

import ast
import runpy
import sys
from importlib.metadata import EntryPoint, entry_points

import pytest

from bench.command import BENCHMARKS
from pipelines.cli import OK, UsageError, main, parser
from pipelines.plugins import GROUP, declared, missing
from tests.support.places import ROOT

BENCH = EntryPoint("bench", "bench.command:register", GROUP)


def test_benchmarks_are_the_modules_with_a_main():
    mains = {
        path.stem
        for path in (ROOT / "bench").glob("*.py")
        if any(isinstance(part, ast.FunctionDef) and part.name == "main" for part in ast.parse(path.read_text()).body)
    }
    assert set(BENCHMARKS) == mains


def test_this_checkout_declares_it_and_is_installed_with_it():
    assert declared() == [BENCH]
    assert BENCH in entry_points(group=GROUP), "what is installed is older than pyproject.toml: pip install -e . again"


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_explains_itself_by_the_same_name_either_way(name, capsys, monkeypatch):
    given = parser([BENCH]).parse_args(["bench", name, "-h"])
    from bench import command

    texts = []
    for start in (lambda: command.run(given), lambda: runpy.run_module(f"bench.{name}", run_name="__main__")):
        monkeypatch.setattr(sys, "argv", ["x", "-h"])
        monkeypatch.delitem(sys.modules, f"bench.{name}", raising=False)  # runpy warns of a module that is loaded
        with pytest.raises(SystemExit) as leaving:
            start()
        assert leaving.value.code == OK
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
    assert f"usage: packuv bench {name}" in texts[0]


def test_unknown_benchmarks_are_refused():
    with pytest.raises(UsageError, match="invalid choice: 'frob'"):
        parser([BENCH]).parse_args(["bench", "frob"])


def test_a_command_that_is_declared_but_not_installed_says_so(monkeypatch, capsys):
    monkeypatch.setattr("pipelines.plugins.entry_points", lambda group: entry_points(group="no such group"))
    assert main(["bench", "raster"]) == 2
    assert capsys.readouterr().err == (
        "packuv: command bench is newer than what is installed; install its package again "
        "(this checkout's: pip install --no-deps -e .)\n"
    )
    assert missing("frob") is None
