"""`packuv view FOLDER` and `packuv run --preview`: what a run has fitted so far, in the browser."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.events import Journal
from pipelines.register import goes_on
from pipelines.request import RunRequest

if TYPE_CHECKING:
    from packuv.viewer.server import Grown
    from packuv.viewer.source import Truth
    from pipelines.unfinished import Part, Unfinished

POLL_SECONDS = 2.0
"""Between two looks at whether something is fitted"""


class Growth:
    """Looks at what the run in the folder of a sequence has fitted."""

    def __init__(self, folder: Path, capture: Path | None) -> None:
        self._folder, self._capture = folder, capture
        self._parts: tuple[Part, ...] = ()

    def look(self) -> Unfinished | None:
        """What there is by now; None where that is what it was at the last look."""
        from pipelines.unfinished import Unfinished, find_parts  # takes seconds

        with contextlib.suppress(OSError):  # something ended between two glances: the next look sees it whole
            parts = find_parts(self._folder)
            if parts and parts != self._parts:
                found = Unfinished(self._folder, self._capture, parts)
                self._parts = parts
                return found
        return None


def view_run(folder: Path, capture: Path | None, host: str, port: int) -> None:
    """Show what is fitted in the browser, from the moment that something is, until Ctrl-C.

    Raises FileNotFoundError where nothing is fitted, and no run goes on.
    """
    from packuv.viewer.server import answer_until_interrupted, bound, check_port

    check_port(port)
    growth, told = Growth(folder, capture), False
    while (first := growth.look()) is None:
        if not goes_on(folder):
            raise FileNotFoundError(f"{folder} holds no scene, and nothing that is fitted; let packuv run go on first")
        if not told:
            print("nothing is fitted yet; the page opens when something is", flush=True)
        told = True
        time.sleep(POLL_SECONDS)
    print(f"shows {first.told}; the page has more as it is there", flush=True)
    with bound(host, port, first, truth=first.truth, grown=_beside_truth(growth)) as server:
        answer_until_interrupted(server, open_browser=True)


@contextlib.contextmanager
def previewing(request: RunRequest, journal: Journal) -> Iterator[None]:
    """Show what a run has fitted while the block runs; the journal is told where, once something is."""
    over = threading.Event()
    thread = threading.Thread(target=_show, args=(request, journal, over), name="preview", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _show(request: RunRequest, journal: Journal, over: threading.Event) -> None:
    from packuv.viewer.server import bound
    from pipelines.process import find_sequence

    try:
        folder = Path(request.out) / find_sequence(request).name
    except (ValueError, OSError):  # the run itself says what is wrong
        return
    growth = Growth(folder, Path(request.capture))
    while (first := growth.look()) is None:
        if over.wait(POLL_SECONDS):
            return
    with bound("127.0.0.1", 0, first, truth=first.truth, grown=_beside_truth(growth)) as server:
        journal.told("preview", server.url)
        threading.Thread(target=server.serve_forever, name="preview server", daemon=True).start()
        over.wait()
        server.shutdown()


def _beside_truth(growth: Growth) -> Grown:
    def grown() -> tuple[Unfinished, Truth | None] | None:
        now = growth.look()
        return (now, now.truth) if now else None

    return grown
