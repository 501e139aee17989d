"""Stages that do nothing but take their time, or fail, in processes and on workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from bench.naps import Nap as Nap
from tasks.artefacts.stage import Notes, Stage, Work


@dataclass(frozen=True, kw_only=True)
class Fails(Stage):
    """Raises what its `kind` names; `died` ends the process."""

    name, version = "fails", 1
    small = True
    kind: str

    def build(self, work: Work) -> Notes:
        match self.kind:
            case "bad input":
                raise ValueError("cam03 has no frames")
            case "missing":
                raise FileNotFoundError(2, "no such thing", "cam03.mp4")
            case "bug":
                raise KeyError("key")
            case "died":
                os.kill(os.getpid(), signal.SIGKILL)
        return {}


@dataclass(frozen=True, kw_only=True)
class Sleeps(Stage):
    """Writes its process and that of a child, then sleeps for a minute."""

    name, version = "sleeps", 1
    small = True
    mark: str

    def build(self, work: Work) -> Notes:
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        work.progress(1, 2, "half")
        Path(self.mark).write_text(f"{os.getpid()} {child.pid}")
        time.sleep(60)
        return {}
