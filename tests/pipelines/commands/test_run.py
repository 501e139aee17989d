"""`packuv run` where output and disks fail and signals come: one sentence, and a code that is true."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from packuv.footage import FrameReader
from pipelines.cli import FAILED, OK, WRONG, main
from pipelines.commands import run as command
from pipelines.results import WHOLE, check_whole
from sync.capture import find_capture
from tasks.artefacts.store import Store
from tests.support.golden import FOLDER, SETTINGS
from tests.support.places import ROOT

CAPTURE = FOLDER / "capture"
CODE = "import sys; from pipelines.cli import main; sys.exit(main())"
MODES = pytest.mark.parametrize("mode", ["--direct", ""], ids=["direct", "prefect"])


def words(out: Path, *more: str) -> list[str]:
    """`packuv run` on the tiny capture."""
    sets = [part for name, value in _flat(SETTINGS) for part in ("--set", f"{name}={value}")]
    asked = ["run", str(CAPTURE), "--out", str(out), "--preset", "draft", "--hold-out", "cam03"]
    return [sys.executable, "-c", CODE, *asked, *sets, *filter(None, more)]


def _flat(settings: dict[str, Any], path: str = "") -> list[tuple[str, Any]]:
    found = []
    for name, value in settings.items():
        match value:
            case dict():
                found += _flat(value, f"{path}{name}.")
            case list():
                found.append((f"{path}{name}", ",".join(map(str, value))))
            case _:
                found.append((f"{path}{name}", value))
    return found


def environment() -> dict[str, str]:
    """That of a user who has set nothing but where the engine's database is: in no file, whose size has limits here."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT")}
    return {**kept, "PREFECT_SERVER_DATABASE_CONNECTION_URL": "sqlite+aiosqlite:///:memory:"}


def bash(script: str, asked: list[str]) -> tuple[int, str]:
    """Exit code and errors of a script in which "$@" is the command."""
    done = subprocess.run(
        ["bash", "-c", script, "bash", *asked],
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    """The output folder of a run that nothing befell."""
    out = tmp_path_factory.mktemp("undisturbed")
    assert bash('"$@"', words(out, "--direct")) == (0, "")
    return out


def begun(undisturbed: Path, out: Path, *missing: str) -> None:
    """The same run before it came to these stages."""
    shutil.copytree(undisturbed / "tiny" / "store", out / "tiny" / "store")
    for stage in missing:
        shutil.rmtree(out / "tiny" / "store" / stage)


def sha256(out: Path) -> str:
    return hashlib.sha256((out / "tiny" / "scene.mkv").read_bytes()).hexdigest()


@pytest.mark.slow
@MODES
def test_a_run_whose_output_nobody_reads_comes_to_its_end(undisturbed, tmp_path, mode):
    begun(undisturbed, tmp_path, "encode", "verify", "evaluate")
    assert bash('"$@" | head -1; exit ${PIPESTATUS[0]}', words(tmp_path, mode)) == (0, "")
    assert sha256(tmp_path) == sha256(undisturbed)
    for streams in (">&- 2>&- <&-", "> /dev/full 2>&1"):
        for name in WHOLE:
            (tmp_path / "tiny" / name).unlink()
        assert bash(f'"$@" {streams}', words(tmp_path, mode)) == (0, "")
        check_whole(tmp_path / "tiny")
    code, errors = bash('"$@" > /dev/full', words(tmp_path, mode, "--json"))
    assert code == FAILED
    assert errors.endswith("packuv: cannot write to standard output: No space left on device\n")
    assert not list(tmp_path.rglob("*.db*")), "the engine's database is in memory, so that no full disk stops it"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "number", "code"),
    [("--direct", signal.SIGHUP, 129), ("", signal.SIGHUP, 129), ("", signal.SIGINT, 130)],
    ids=["direct-hup", "prefect-hup", "prefect-int"],
)
def test_signals_leave_run_json_and_no_job(undisturbed, tmp_path, mode, number, code):
    begun(undisturbed, tmp_path, "motion")
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(words(tmp_path, mode), cwd=ROOT, env=environment(), text=True, **pipes) as run:
        while not list(tmp_path.glob("tiny/store/.work/motion-*/*/job.log")):
            assert run.poll() is None
            time.sleep(0.05)
        for _ in range(2):
            run.send_signal(number)
            time.sleep(0.05)
        errors = run.communicate(timeout=60)[1]
    assert run.returncode == code
    assert errors.count("\n") == 1
    assert errors.endswith("; the same command goes on from here\n")
    record = json.loads((tmp_path / "tiny" / "run.json").read_text())
    outcomes = {event["stage"]: event["outcome"] for event in record["stages"]}
    assert outcomes["points"] == "reused"
    assert outcomes.get("motion", "failed") == "failed"
    assert not [line for line in _commands() if os.fsencode(tmp_path) in line]


def _commands() -> Iterator[bytes]:
    """Of all processes."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it ended meanwhile
            yield path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "limits"), [("--direct", [8, 20, 90]), ("", [8])], ids=["direct", "prefect"])
def test_files_that_cannot_be_written_cost_one_sentence_and_no_artefact(undisturbed, tmp_path, mode, limits):
    """The system refuses to make files longer than so many kilobytes, which needs no root and no disk of its own."""
    begun(undisturbed, tmp_path, "motion", "background", "key", "segment", "encode", "verify", "evaluate")
    for limit in limits:
        code, errors = bash(f'ulimit -f {limit}; "$@"', words(tmp_path, mode))
        assert code == FAILED
        assert re.fullmatch(rf"packuv: File too large: {tmp_path}/tiny/\S+\n", errors)
        assert Store(tmp_path / "tiny" / "store").verify() == []
    assert bash('"$@"', words(tmp_path, mode)) == (0, "")
    assert sha256(tmp_path) == sha256(undisturbed)


@pytest.mark.parametrize("lost", WHOLE)
def test_a_whole_run_has_all_its_files(tmp_path, monkeypatch, capsys, lost):
    def ends(request, journal, *, direct):
        class Outcome:
            folder, missed = tmp_path, ""

            def farewell(self) -> str:
                return "done"

        return Outcome()

    for name in WHOLE:
        (tmp_path / name).touch()
    monkeypatch.setattr(command, "run", ends)
    asked = ["run", str(CAPTURE), "--out", str(tmp_path)]
    assert main(asked) == OK
    (tmp_path / lost).unlink()
    assert main([*asked, "--stop-after", "flow"]) == OK
    assert main(asked) == FAILED
    assert f"{tmp_path / lost} is not there" in capsys.readouterr().err


def write_masks(capture: Path, *cameras: str, empty: tuple[str, ...] = ()) -> None:
    """Of what is not as it mostly is; of some cameras empty ones."""
    reader = FrameReader(find_capture(capture).videos)
    for name in (*cameras, *empty):
        pictures = np.stack([reader.read(name, frame) for frame in range(reader.frame_count(name))]).astype(int)
        folder = capture / "masks" / name
        folder.mkdir(parents=True)
        for frame, picture in enumerate(pictures):
            ahead = np.abs(picture - np.median(pictures, axis=0)).max(axis=2) > 20
            grown = cv2.dilate(ahead.astype(np.uint8), np.ones((5, 5), np.uint8))
            cv2.imwrite(str(folder / f"{frame:06d}.png"), 255 * grown * (name not in empty))


def made_in(out: Path) -> dict[str, list[str]]:
    """Artefacts of the last run by stage."""
    found = dict[str, list[str]]()
    (told,) = (json.loads(path.read_text()) for path in out.glob("*/run.json"))
    for item in told["artefacts"]:
        found.setdefault(item["artefact"].partition("/")[0], []).append(item["artefact"])
    return found


@pytest.mark.slow
def test_masks_that_come_later_redo_what_they_are_used_for_and_doubtful_ones_nothing(tmp_path, capsys):
    capture, out = shutil.copytree(CAPTURE, tmp_path / "capture"), tmp_path / "out"
    asked = ["run", str(capture), *words(out, "--direct")[5:]]
    assert main(asked) == OK
    plain, scene = made_in(out), next(out.glob("*/scene.mkv")).read_bytes()
    write_masks(capture, empty=("cam02", "cam03"))  # the second of which is held out
    assert main(asked) == OK
    doubtful = made_in(out)
    assert len(doubtful.pop("masks")) == 2
    assert len(doubtful.pop("mask_files")) == 1
    assert doubtful == plain
    assert "2 cameras have masks that do not fit what moves and are not used: cam02, cam03" in capsys.readouterr().out

    shutil.rmtree(capture / "masks")
    write_masks(capture, "cam01", "cam03", empty=("cam02",))
    assert main(asked) == OK
    masked = made_in(out)
    changed = {stage for stage in plain if masked[stage] != plain[stage]}
    assert changed == {"background", "backdrop", "key", "segment", "encode", "verify", "evaluate"}
    (told,) = (json.loads(path.read_text()) for path in out.glob("*/run.json"))
    scores = next(item["notes"]["mean"] for item in told["artefacts"] if item["artefact"].startswith("evaluate/"))
    assert 0 < scores["foreground_share"] < 0.5
    assert scores["psnr_foreground_db"] > 5

    afresh = tmp_path / "afresh"
    assert main(["run", str(capture), *words(afresh, "--direct")[5:]]) == OK
    assert made_in(afresh) == masked
    assert next(afresh.glob("*/scene.mkv")).read_bytes() == next(out.glob("*/scene.mkv")).read_bytes()

    shutil.rmtree(capture / "masks")
    assert main(asked) == OK
    assert made_in(out) == plain
    assert next(out.glob("*/scene.mkv")).read_bytes() == scene


def test_what_only_seems_to_be_masks_is_told_by_plan_and_run(tmp_path, capsys):
    capture, out = shutil.copytree(CAPTURE, tmp_path / "capture"), tmp_path / "out"
    (capture / "matte").mkdir()
    asked, told = [str(capture), "--out", str(out), "--preset", "draft"], "matte/ seems to hold foreground masks and is"
    assert main(["plan", *asked]) == OK
    assert told in capsys.readouterr().out
    assert main(["run", *asked, "--direct", "--stop-after", "sync"]) == OK
    assert f"look at    {told}" in capsys.readouterr().out


def test_masks_that_do_not_fit_end_plan_and_run_before_any_work(tmp_path, capsys):
    capture, out = shutil.copytree(CAPTURE, tmp_path / "capture"), tmp_path / "out"
    asked = [str(capture), "--out", str(out), "--preset", "draft", "--hold-out", "cam03"]
    run, plan = ["run", *asked, "--direct"], ["plan", *asked]

    def refused(told: str, *made: str) -> None:
        for words in (plan, run, plan):  # the last of which meets what the run left
            assert main(words) == WRONG
            assert told in capsys.readouterr().err
            stores = out.glob("*/store/[!.]*")
            assert {path.name for path in stores if path.is_dir() and any(path.glob("[!.]*/receipt.json"))} == {*made}

    write_masks(capture, "cam02", "cam03")  # the second of which is held out
    last = max((capture / "masks" / "cam03").iterdir())
    whole = last.read_bytes()
    last.unlink()
    refused("cam03 must have a mask for each of the")
    last.write_bytes(whole[:-20])
    refused(f"cam03: {last.name} is damaged: it is cut short")
    cv2.imwrite(str(last), np.zeros((4, 4), np.uint8))
    refused(f"but {last.name} is 4x4")
    last.write_bytes(whole)
    assert main([*run, "--stop-after", "sync"]) == OK
    last.write_bytes(whole[:-20])
    refused(f"cam03: {last.name} is damaged: it is cut short", "mask_files", "sync")
    last.parent.rename(last.parent.with_name("cam33"))
    refused("cam33 belongs to no video; did you mean 'cam03'?", "mask_files", "sync")
