"""What commands print: progress while they work, then facts for people or as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from packuv.progress import Progress
from pipelines.commands.output import answer
from pipelines.commands.progress import TerminalProgress
from pipelines.events import Journal


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
