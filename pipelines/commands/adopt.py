"""`packuv adopt`: capture folders of a data set as it is published, by links."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from pipelines.adopt import Scene, adopt, find_scenes
from pipelines.commands.terminal import print_facts, print_table
from sync.masks import MASKS, WANTED


def command(arguments: argparse.Namespace) -> int:
    """Exit code 0 if a capture was made of every scene that was found."""
    dataset: Path = arguments.dataset
    out = arguments.out or dataset.absolute().with_name(f"{dataset.absolute().name}-captures")
    if out.resolve().is_relative_to(dataset.resolve()):
        raise ValueError(f"captures must not lie in the data set, but {out} does; name another folder with --out")
    made = [(scene, adopt(scene, out)) for scene in find_scenes(dataset)]
    if arguments.json:
        print_facts({"captures": [_facts(scene, folder) for scene, folder in made]}, True, str)
    else:
        print_table(_table([_facts(scene, folder) for scene, folder in made]))
        for scene, folder in made:
            for name in scene.unread:
                print(
                    f"{scene.name}: {name} seems to hold masks, but of none of its cameras, and is not linked; lay "
                    f"them into {folder / MASKS}, as {WANTED}"
                )
    return 0


def _facts(scene: Scene, folder: Path) -> dict[str, Any]:
    return {
        "capture": str(folder),
        "calibration": scene.calibration.format.KIND,
        "cameras": len(scene.cameras),
        "held_out": list(scene.held_out),
        "masks": len(scene.masks),
        "masks_unread": list(scene.unread),
        "timecodes": len(scene.timecodes),
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table("capture", "calibration", "cameras", "held out")
    for row in rows:
        table.add_row(
            *(Text(str(row[key])) for key in ("capture", "calibration", "cameras")), ", ".join(row["held_out"])
        )
    return table
