"""Kill runs at random moments, again and again: every one must end with the same bytes.

    python -m bench.kills CAPTURE --out runs/kills --kills 50 --set fit.iterations=200

Each time a run is started, and after a random time one of its processes is killed with -9: the run itself, a job, or
the workflow server. A run whose job or server was killed must end, by itself and within a minute, or go on; the same
command then goes on where it stopped. When a run comes to its end, its scene is compared with that of a run that
nobody disturbed, every artefact with its receipt, and the next run starts from nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench import command
from tasks.artefacts.store import find_stores

VICTIMS = {"run": "pipelines.cli run", "job": "tasks.artefacts.jobs", "server": "pipelines.server"}
"""What is killed, and the words of its command line"""
ENDING_SECONDS = 60.0
"""For a run that lost its server or a job, unless it goes on"""


@dataclass(frozen=True)
class Kill:
    """One kill and what came of it."""

    victim: str
    after_seconds: float
    """Since the start of the command"""
    stages: int
    """Artefacts that were complete then"""
    code: int
    """Exit code of the run; -9 where it was the victim"""
    ended_after_seconds: float
    sentence: str
    """The last line that the run said"""


@dataclass(frozen=True)
class Trial:
    """A capture, and how it is run."""

    capture: Path
    out: Path
    settings: tuple[str, ...]

    def command(self, out: Path) -> list[str]:
        words = [
            sys.executable,
            "-m",
            "pipelines.cli",
            "run",
            str(self.capture),
            "--out",
            str(out),
            "--preset",
            "draft",
        ]
        return [*words, "--name", "trial", *(word for setting in self.settings for word in ("--set", setting))]


def undisturbed(trial: Trial) -> tuple[str, float]:
    """SHA-256 of the scene, and seconds, of a run that nobody kills."""
    start = time.monotonic()
    subprocess.run(trial.command(trial.out / "undisturbed"), check=True, stdout=subprocess.DEVNULL)
    return _sha256(trial.out / "undisturbed" / "trial" / "scene.mkv"), time.monotonic() - start


def kill_once(trial: Trial, out: Path, rng: random.Random, within_seconds: float) -> Kill | None:
    """Start the run, and kill one of its processes; None if it came to its end before."""
    log = trial.out / "last.log"
    with open(log, "wb") as output:
        process = subprocess.Popen(trial.command(out), stdout=output, stderr=output, start_new_session=True)
    start, wait = time.monotonic(), rng.uniform(0.5, within_seconds)
    victim, pid = rng.choice(list(VICTIMS)), None
    while process.poll() is None and pid is None:
        time.sleep(0.05)
        if time.monotonic() - start >= wait:
            pid = _pid(process.pid, victim)
    if pid is None:
        return None
    stages = len(list(out.glob("*/store/*/*/receipt.json")))
    after = time.monotonic() - start
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    killed = time.monotonic()
    while process.poll() is None and (victim != "server" or time.monotonic() - killed < ENDING_SECONDS):
        time.sleep(0.05)
    ended = time.monotonic() - killed
    if process.poll() is None:
        process.kill()
        raise RuntimeError(f"the run lives {ended:.0f} s after its server was killed; see {log}")
    lines = log.read_text(errors="replace").strip().splitlines()
    return Kill(victim, round(after, 2), stages, process.returncode, round(ended, 2), lines[-1] if lines else "")


def run(trial: Trial, kills: int, seed: int) -> dict[str, Any]:
    """All kills; raises RuntimeError for a difference."""
    expected, seconds = undisturbed(trial)
    rng, found, finished = random.Random(seed), list[Kill](), 0
    out = trial.out / "killed"
    shutil.rmtree(out, ignore_errors=True)
    while len(found) < kills:
        kill = kill_once(trial, out, rng, within_seconds=seconds / 2)
        if kill is not None:
            found.append(kill)
            print(f"{len(found):3d} {kill.victim:<6} {kill.after_seconds:5.1f} s  {kill.sentence[:90]}", flush=True)
        if (out / "trial" / "scene.mkv").exists():
            _finish(trial, out, expected)
            finished += 1
            shutil.rmtree(out)
    _finish(trial, out, expected)
    return {
        "sha256": expected,
        "seconds": round(seconds, 1),
        "runs": finished + 1,
        "kills": [asdict(one) for one in found],
    }


def _finish(trial: Trial, out: Path, expected: str) -> None:
    subprocess.run(trial.command(out), check=True, stdout=subprocess.DEVNULL)
    if (found := _sha256(out / "trial" / "scene.mkv")) != expected:
        raise RuntimeError(f"{out} came to another scene: {found}, not {expected}")
    if damage := [damage for store in find_stores(out) for damage in store.verify()]:
        raise RuntimeError(f"{out} has damaged artefacts: {damage[0]}")


def _pid(run: int, victim: str) -> int | None:
    """A process of the run's family with these words in its command line."""
    family, found = [run], []
    while family:
        pid = family.pop()
        with contextlib.suppress(OSError):
            words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if VICTIMS[victim] in words:
                found.append(pid)
            for task in Path(f"/proc/{pid}/task").iterdir():
                family += [int(child) for child in (task / "children").read_text().split()]
    return found[-1] if found else None


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main(argv: Sequence[str] | None = None) -> None:
    """Run the trial and write what came of it."""
    parser = command.parser("kills", __doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder for runs, emptied at the start of each")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--json", type=Path, default=None, help="file for the result")
    given = parser.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    result = run(Trial(given.capture.absolute(), given.out.absolute(), tuple(given.set)), given.kills, given.seed)
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + "\n")
    count = {victim: sum(kill["victim"] == victim for kill in result["kills"]) for victim in VICTIMS}
    print(f"{len(result['kills'])} kills ({count}) in {result['runs']} runs: {result['sha256'][:16]} every time")


if __name__ == "__main__":
    main()
