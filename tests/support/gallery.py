"""The pictures of README and docs, and the scene in examples/, of the demo's run: `make pictures`.

    python -m tests.support.gallery RUN

All are what the product shows: sections of the report, the viewer's page, `packuv atlas`. Chromium takes them.
"""

from __future__ import annotations

import queue
import sys
import tempfile
import threading
from pathlib import Path

import cv2
import numpy as np

from packuv.atlas import sheet
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvsize import UvOptions
from packuv.scene import open_scene, write_scene
from packuv.viewer import serve
from tests.support.browser import Browser, running_browser
from tests.support.places import ROOT

PICTURES, SCENE = ROOT / "docs/pictures", ROOT / "examples/studio.mkv"
MOST_BYTES = 1_000_000
"""Of all pictures together, and of the scene"""
QUALITY = 82
"""Of WebP"""
WIDTH, HEIGHT = 1000, 640
FRAMES = 12
"""Of the scene in examples/, at most"""
MAP = UvOptions(rows=256, columns=256, layers=8)
"""Of the atlas: small, so that texels are seen"""


def main(run: Path) -> None:
    """Make them all anew from the folder of a run, whose report and scene are there."""
    PICTURES.mkdir(exist_ok=True)
    frame = _shorter(run / "scene.mkv", SCENE) // 2
    with tempfile.TemporaryDirectory() as folder, running_browser(Path(folder)) as browser:
        _of_report(browser, run / "report.html")
        _of_viewer(browser, SCENE, frame)
    with open_scene(SCENE) as scene:
        _save("atlas", sheet(scene, frame, options=MAP, triplet=None))
    sizes = {path.name: path.stat().st_size for path in sorted(PICTURES.iterdir())}
    print(*(f"{name:12} {size:,}" for name, size in sizes.items()), sep="\n")
    if sum(sizes.values()) > MOST_BYTES:
        raise SystemExit(f"pictures must have {MOST_BYTES:,} bytes at most, but have {sum(sizes.values()):,}")


def _of_report(browser: Browser, page: Path) -> None:
    browser.open(page.resolve().as_uri(), WIDTH, HEIGHT)
    browser.wait_for("document.readyState == 'complete'")
    _save("report", browser.picture())
    for name, element in (("truth", "#pictures .trio"), ("motion", "#motion svg")):
        _save(name, _part(browser, element))


def _part(browser: Browser, element: str) -> np.ndarray:
    """What an element looks like, scrolled to the top of the page."""
    browser.evaluate(f"document.querySelector('{element}').scrollIntoView()")
    box = f"document.querySelector('{element}').getBoundingClientRect()"
    left, top, width, height = (round(browser.evaluate(f"{box}.{side}")) for side in ("left", "top", "width", "height"))
    return browser.picture()[max(top, 0) : top + height, max(left, 0) : left + width]


def _of_viewer(browser: Browser, scene: Path, frame: int) -> None:
    found: queue.Queue[str] = queue.Queue()
    threading.Thread(target=serve, args=(scene,), kwargs={"announce": found.put}, daemon=True).start()
    browser.open(f"{found.get(timeout=60)}#play=0&frame={frame}", WIDTH, HEIGHT)
    browser.wait_for(f"document.documentElement.dataset.frame == {frame}", seconds=300)
    _save("viewer", browser.picture())


def _shorter(source: Path, out: Path) -> int:
    """Write the first frames of a scene, lossless, half as many as long as they are too large; returns their number."""
    frames = FRAMES
    with open_scene(source) as scene, tempfile.TemporaryDirectory() as folder:
        whole, part = scene.segment(0), Path(folder, "0.npz")
        while frames:
            rows = whole.key, whole.dynamic, whole.xyz[: frames - 1], whole.attributes[: frames - 1]
            Segment(0, *rows).save(part)
            if write_scene(out, [part], scene.header.first(frames)).bytes <= MOST_BYTES:
                return frames
            frames //= 2
    raise SystemExit(f"not one frame of {source} fits into {MOST_BYTES:,} bytes")


def _save(name: str, pixels: np.ndarray) -> None:
    """uint8 [H, W, 3], RGB."""
    height, width = pixels.shape[:2]
    if width > WIDTH:
        pixels = cv2.resize(pixels, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    if not cv2.imwrite(str(PICTURES / f"{name}.webp"), bgr, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise SystemExit(f"{name} of {pixels.shape} cannot be written as WebP")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
