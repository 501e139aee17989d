"""`packuv bench NAME`: measure this machine, or a fitted scene on it."""

from __future__ import annotations

import argparse
import runpy
import sys


def measure(arguments: argparse.Namespace) -> int:
    """Run a benchmark as `python -m bench.NAME` does, with what follows its name."""
    sys.argv = [f"packuv bench {arguments.name}", *arguments.rest]
    runpy.run_module(f"bench.{arguments.name}", run_name="__main__")
    return 0
