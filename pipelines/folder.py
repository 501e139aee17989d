"""The folder of a sequence's results, which belongs to one capture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sync.capture import Capture
from tasks.artefacts.digests import signature
from tasks.artefacts.recipe import write_json

IDENTITY = "sequence.json"


def claim(folder: Path, capture: Capture) -> None:
    """Make the folder this capture's, if it is nobody's yet.

    Raises ValueError where it holds the results of another capture. One that was moved is the same: its old place is
    gone, and its videos have the names and sizes that are remembered. ValueError, too, where what is remembered is
    damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    own = _identity(capture)
    path = folder / IDENTITY
    if not path.exists():
        write_json(path, own)
        return
    known = _known(path)
    if known["capture"] == own["capture"]:
        return
    if Path(known["capture"]).exists() or known["videos"] != own["videos"]:
        raise ValueError(
            f"{folder} holds the results of {known['capture']}, but this capture is {own['capture']}; choose another "
            "--out, or another name: --name, or name = in capture.toml"
        )
    write_json(path, own)


def _known(path: Path) -> dict[str, Any]:
    try:
        known = json.loads(path.read_bytes())
        return {name: known[name] for name in ("capture", "videos")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} must tell whose results lie beside it, but is damaged ({error}); remove it if they are this "
            "capture's, or choose another --out"
        ) from None


def _identity(capture: Capture) -> dict[str, Any]:
    videos = {name: signature(path)[0] for name, path in capture.videos.items()}
    return {"capture": str(capture.folder.resolve()), "videos": videos}
