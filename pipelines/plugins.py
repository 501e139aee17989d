"""Commands that other packages add to `packuv`: entry points of the group `packuv.commands`.

An entry point bears the name of its command and leads to a function, `register(add)`, which says the grammar:

    def register(add: Add) -> None:
        command = add("bench.command:run", "run one of the benchmarks")  # what runs, in text so that help stays fast
        command.add_argument("name")

This package knows none of them. What cannot be loaded is told and left out; the other commands go on.
"""

from __future__ import annotations

import tomllib
from argparse import ArgumentParser
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

GROUP = "packuv.commands"
PROJECT = Path(__file__).parents[1] / "pyproject.toml"
"""Of a checkout; an installed package has none"""

Add = Callable[[str, str], ArgumentParser]
"""Function as "module:name" and a line of help -> the parser of the command, for its arguments"""


def plug_in(
    add: Callable[[str, str, str], ArgumentParser], say: Callable[[str], object], found: Iterable[EntryPoint] | None
) -> None:
    """Add the commands of these entry points, by default of all that are installed."""
    for entry in sorted(entry_points(group=GROUP) if found is None else found, key=lambda entry: entry.name):
        try:
            entry.load()(partial(add, entry.name))
        except Exception as error:  # of somebody else's code, whatever it is
            say(f"command {entry.name} ({entry.value}) is left out: {error or type(error).__name__}; {REMEDY}")


REMEDY = "install its package again (this checkout's: pip install --no-deps -e .)"


def declared(project: Path = PROJECT) -> list[EntryPoint]:
    """What this checkout declares, whether it is installed or not."""
    if not project.is_file():
        return []
    scripts = tomllib.loads(project.read_text())["project"].get("entry-points", {}).get(GROUP, {})
    return [EntryPoint(name, value, GROUP) for name, value in scripts.items()]


def missing(name: str) -> str | None:
    """What to do about a command that this checkout declares, but that was not there when it was installed."""
    if name in entry_points(group=GROUP).names or name not in [entry.name for entry in declared()]:
        return None
    return f"command {name} is newer than what is installed; {REMEDY}"
