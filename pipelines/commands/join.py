"""`packuv join`: one video of the chapters that a camera recorded."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from pipelines.commands.terminal import print_facts, shown
from pipelines.join import join


def command(arguments: argparse.Namespace) -> int:
    with shown(arguments, "join") as progress:
        joined = join(arguments.capture, progress)
    facts = {"videos": [{"video": str(one.video), "chapters": one.chapters, "frames": one.frames} for one in joined]}
    print_facts(facts, arguments.json, _text)
    return 0


def _text(facts: Mapping[str, Any]) -> str:
    lines = [f"{one['video']}: {one['chapters']} chapters, {one['frames']:,} frames" for one in facts["videos"]]
    return "\n".join(lines) or "no camera has chapters to join"
