"""Commands of other packages: what is sound is there, what is broken is told, and the rest goes on."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from pipelines.cli import parser
from pipelines.plugins import GROUP, declared

SOUND = """
def register(add):
    add("made_up_plugin:run", "do something").add_argument("word")

def register_too_much(add):
    add("made_up_plugin:run", "do something")
    raise TypeError("halfway")
"""


@pytest.fixture(autouse=True)
def plugin(tmp_path, monkeypatch):
    (tmp_path / "made_up_plugin.py").write_text(SOUND)
    (tmp_path / "broken_plugin.py").write_text("import no_such_module\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("made_up_plugin", None)


def entry(value: str, name: str = "extra") -> EntryPoint:
    return EntryPoint(name, value, GROUP)


def test_a_command_is_added():
    given = parser([entry("made_up_plugin:register")]).parse_args(["extra", "hello"])
    assert (given.command, given.function, given.word) == ("extra", "made_up_plugin:run", "hello")


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (entry("no_such_plugin:register"), "No module named 'no_such_plugin'"),
        (entry("broken_plugin:register"), "No module named 'no_such_module'"),
        (entry("made_up_plugin:no_such_function"), "no_such_function"),
        (entry("made_up_plugin:register_too_much"), "halfway"),
        (entry("made_up_plugin:register", name="run"), "conflicting subparser: run"),
    ],
)
def test_what_is_broken_is_one_line_and_the_rest_goes_on(broken, message, capsys):
    grammar = parser([broken, entry("made_up_plugin:register", "sound")])
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"packuv: command {broken.name} ({broken.value}) is left out: ")
    assert message in lines[0]
    assert grammar.parse_args(["info", "a.mkv"]).scene == Path("a.mkv")
    assert grammar.parse_args(["sound", "hello"]).word == "hello"
    assert grammar.parse_args(["run", "capture", "--out", "o"]).function == "pipelines.commands.run:command"


def test_an_installed_package_declares_nothing(tmp_path):
    assert declared(tmp_path / "pyproject.toml") == []
