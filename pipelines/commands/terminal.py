"""What commands print: progress while they work, then facts for people or as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from packuv.progress import Progress
from pipelines.commands.output import answer
from pipelines.commands.progress import TerminalProgress
from pipelines.events import Journal

if TYPE_CHECKING:
    from rich.table import Table


@contextmanager
def shown(arguments: argparse.Namespace, label: str) -> Iterator[Progress]:
    """A callback (done, total, note) that shows progress on the terminal while the block runs."""
    progress = TerminalProgress(sys.stderr if getattr(arguments, "json", False) else sys.stdout)
    journal = Journal(progress)
    journal.started(label)
    try:
        yield partial(journal.moved, label)
    finally:
        progress.close()


def print_facts(facts: Mapping[str, Any], as_json: bool, text: Callable[[Mapping[str, Any]], str]) -> None:
    """The answer of a command."""
    answer(json.dumps(facts, indent=1) if as_json else text(facts))


def print_table(table: Table) -> None:
    """A table that fits a terminal; in a file or pipe, whole lines however long."""
    from rich.console import Console

    wide = None if sys.stdout.isatty() else 1000
    Console(highlight=False, width=wide).print(table)
