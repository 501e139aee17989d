"""What the viewer's page receives and what that costs: bytes beside the scene file's, CPU time in V8 and in the server.

    packuv bench page --scene SCENE.mkv --out runs/page.json

Times of the page need the program `node`, which has the engine of Chromium, and a first segment of nine frames or more;
they are those of the page's own worker, median of 15. Those of the server are for making a body, decoding included.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench import command
from packuv.viewer import server
from packuv.viewer.bodies import Bodies
from packuv.viewer.source import SceneSource, describe, open_source

VIEWER = Path(server.__file__).parent


def main(words: Sequence[str] | None = None) -> None:
    """Measure one scene file and write what was found."""
    parser = command.parser("page", __doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a scene file")
    parser.add_argument("--out", type=Path, required=True, help="a new JSON file")
    arguments = parser.parse_args(words)
    with open_source(arguments.scene) as source:
        found = {"scene_bytes": arguments.scene.stat().st_size, **measure(source)}
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


def measure(source: SceneSource) -> dict[str, Any]:
    """Sizes of all bodies, what comes before the first picture, and CPU time."""
    bodies, began = Bodies(source), time.process_time()
    parts = [[bodies.part(k, part) for part in range(bodies.parts(k))] for k in range(len(source.segments))]
    keys_seconds, began = time.process_time() - began, time.process_time()
    frames = [bodies.frame(frame) for segment in source.segments for frame in segment[1:]]
    frames_seconds = time.process_time() - began
    page = sum(len(zlib.compress((VIEWER / name).read_bytes())) for name, _ in server.PAGES.values())
    told = len(zlib.compress(json.dumps(describe(source)).encode()))
    return {
        "rows": len(source.key(0)),
        "moving": int(source.dynamic(0).sum()),
        "key_bytes": sum(len(body) for segment in parts for body in segment),
        "frame_bytes": sum(map(len, frames)),
        "first_picture_bytes": page + told + len(parts[0][0]),
        "page_bytes": page,
        "server_key_cpu_ms": 1000 * keys_seconds / len(parts),
        "server_frame_cpu_ms": 1000 * frames_seconds / max(1, len(frames)),
        "page_cpu_ms": _page_times(source, parts[0], frames),
    }


def _page_times(source: SceneSource, parts: Sequence[bytes], frames: Sequence[bytes]) -> dict[str, float] | None:
    """Of the page's worker on the first segment; None without node or where the segment is short."""
    node = shutil.which("node")
    if not node or len(source.segments[0]) <= 8:
        return None
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "scene.json").write_text(json.dumps(describe(source)))
        for number, part in enumerate(parts):
            (folder / f"part{number}").write_bytes(part)
        for frame in (4, 8):
            (folder / f"frame{frame}").write_bytes(frames[frame - 1])
        script = Path(__file__).with_name("page.js")
        ran = subprocess.run(
            [node, str(script), str(VIEWER / "worker.js"), made], check=True, capture_output=True, text=True
        )
    times: dict[str, float] = json.loads(ran.stdout)
    return times


if __name__ == "__main__":
    main()
