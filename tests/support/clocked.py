"""How soon the page shows a picture: after `packuv view` has named its address, and after seeking; in Chromium.

    python -m tests.support.clocked SCENE.mkv

The page draws by software and shares the machine with the browser and the server; the first page that a browser opens
takes longest and does not count.
"""

from __future__ import annotations

import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from packuv.scene import open_scene
from tests.support.browser import Browser, running_browser

PAGES = 8
"""Opened one after another, each of a `packuv view` of its own"""
SEEKS = (1.0, 0.5, 0.74, 0.0, 0.37, 0.88, 0.23, 0.62, 0.93)
"""Where to, shares of the scene"""
WIDTH, HEIGHT = 640, 360
SEEK = """
window.arrived = 0; window.asked = performance.now();
new MutationObserver((_, watch) => {
  if (arrived || document.documentElement.dataset.frame != FRAME) return;
  arrived = performance.now(); watch.disconnect();
}).observe(document.documentElement, {attributes: true});
{
  const bar = document.getElementById("scrub"); bar.value = FRAME;
  for (const kind of ["input", "change"]) bar.dispatchEvent(new Event(kind));
}
"""


def main(scene: Path) -> None:
    """Print milliseconds of all, and their medians."""
    with open_scene(scene) as opened:
        count = len(opened)
    with tempfile.TemporaryDirectory() as folder, running_browser(Path(folder)) as browser:
        first = [_viewed(browser, scene, []) for _ in range(PAGES)]
        print(f"first picture, ms: {_told([found for (found,) in first[1:]])}")
        (_, *sought) = _viewed(browser, scene, [round(share * (count - 1)) for share in SEEKS])
        print(f"seek, ms: {_told(sought)}")


def _viewed(browser: Browser, scene: Path, frames: list[int]) -> list[float]:
    """Milliseconds to the first picture of a page just opened, and to those of frames sought after it."""
    command = [sys.executable, "-m", "pipelines.cli", "view", str(scene), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        url = next(found[0] for line in server.stdout if (found := re.search(r"http://\S+", line)))
        try:
            browser.open(f"{url}#play=0", WIDTH, HEIGHT)
            browser.wait_for("document.documentElement.dataset.first !== undefined")
            found = [float(browser.evaluate("document.documentElement.dataset.first"))]
            for frame in frames:
                browser.evaluate(SEEK.replace("FRAME", str(frame)))
                browser.wait_for("arrived > 0")
                found.append(browser.evaluate("arrived - asked"))
        finally:
            server.terminate()
    return found


def _told(values: list[float]) -> str:
    return f"median {statistics.median(values):.0f} of {', '.join(f'{value:.0f}' for value in values)}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
