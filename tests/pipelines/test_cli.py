"""The `packuv` command: grammar, exit codes, one sentence per error."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from packuv import bounds
from pipelines import cli
from pipelines.cli import FAILED, INTERRUPTED, MOST_RATE_PART, OK, WRONG, main, parser
from pipelines.commands.run import request_from
from pipelines.request import RunRequest, read_settings
from tests.packuv.test_score import LIGHT, write_wall


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["frob"], "invalid choice: 'frob'"),
        (["run", "capture"], "the following arguments are required: --out"),
        (["run", "capture", "--out", "o", "--preset", "best"], "invalid choice: 'best'"),
        (["run", "capture", "--out", "o", "--frames", "3:1"], "must be A:B with 0 <= A < B, as 0:30"),
        (["run", "capture", "--out", "o", "--frames", "three"], "must be A:B with 0 <= A < B"),
        (["plan", "capture", "--out", "o", "--frames", "-3"], "must be A:B with 0 <= A < B"),
        *(
            ([*words, "--frames", "-1:3"], "must be A:B with 0 <= A < B, as 0:30 for the first thirty, but is '-1:3'")
            for words in (
                ["run", "capture", "--out", "o"],
                ["batch", "a.parquet", "--out", "o"],
                ["export", "a.mkv", "-o", "d"],
                ["render", "a.mkv", "--camera", "a", "-o", "d"],
            )
        ),
        (["run", "capture", "--out", "o", "--jobs", "0"], "must be a whole number from 1 on, but is '0'"),
        (["run", "capture", "--out", "o", "--unknown"], "unrecognized arguments: --unknown"),
        (["run", "capture", "--out", "o", "--dir"], "unrecognized arguments: --dir"),
        (["sync", "capture", "--out", "o", "--stop-after", "fit"], "unrecognized arguments: --stop-after fit"),
        (["simulate", "out", "--size", "640"], "must be WIDTHxHEIGHT in pixels"),
        (["export"], "the following arguments are required: WHAT; see packuv export --help"),
        (["export", "nowhere.mkv", "-o", "a.ply"], "one of the arguments --frame --frames is required"),
        (["export", "nowhere.mkv", "--frame", "0", "-o", "a.ply"], "nowhere.mkv"),
        (["export", "frames", "nowhere.mkv", "--frame", "0", "-o", "a.txt"], "a.txt does not tell its format"),
        (["export", "cameras", "a.mkv", "-o", "out"], "the following arguments are required: --to"),
        (["export", "atlas", "a.mkv", "-o", "b.mkv", "--codec", "ffv1", "--crf", "9"], "ffv1 is always lossless"),
        (["export", "atlas", "a.mkv", "-o", "b.mkv", "--lossless", "--crf", "9"], "not allowed with argument"),
        (["export", "atlas", "a.mkv", "-o", "b.mkv", "--map", "100"], "choose multiples"),
        (["import", "nowhere.ply", "-o", "a.mkv"], "no splat file or folder nowhere.ply"),
        (["import", "a.ply", "--fps", "0", "-o", "a.mkv"], "must be a rate above 0 as 30, 29.97 or 30000/1001"),
        (["import", "a.ply", "--fps", "29.97002997002997", "-o", "a.mkv"], "parts of the fraction up to 2147483647"),
        (["film", "a.mkv", "p.json", "--fps", "1/2147483648", "-o", "a.mp4"], "both parts of the fraction up to"),
        (["atlas", "nowhere.mkv", "--frame", "0", "-o", "a.png"], "nowhere.mkv"),
        (["web", "nowhere.mkv", "-o", "site"], "nowhere.mkv"),
        (["verify"], "one of the arguments SCENE --store is required"),
        (["serve", "--out", "o", "--port", "99999"], "must be a port from 1 to 65535, but is '99999'"),
        (["serve", "--out", "o", "--data", "nowhere"], "no manifest or folder of captures nowhere"),
        (["run", "nowhere", "--out", "o"], "no capture folder"),
        (["run", "nowhere", "--out", "o", "--set", "fit.iterations"], "--set needs NAME=VALUE"),
        (["run", "nowhere", "--out", "o", "--config", "none.toml"], "no file none.toml; --config needs a TOML file"),
        (["info", "nowhere.mkv"], "nowhere.mkv"),
        (["verify", "--store", "nowhere"], "no folder nowhere"),
    ],
)
def test_wrong_usage_is_one_sentence_and_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == WRONG
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert message in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        "",
        *cli.SINGLE,
        *("run", "simulate", "info", "verify", "render", "eval", "view", "import", "atlas", "web", "manifest"),
        *("export", "export frames", "export cameras", "export atlas"),
    ],
)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as leaving:
        main([*command.split(), "--help"])
    assert leaving.value.code == OK
    text = capsys.readouterr().out
    assert f"usage: packuv {command}".strip() in text
    assert "None" not in text


def test_rates_end_where_those_of_files_do():
    assert MOST_RATE_PART == bounds.MOST_RATE_PART


def test_help_imports_nothing_heavy():
    code = "import sys; from pipelines.cli import parser; parser(); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "torch", "numba", "prefect", "av", "cv2", "pyarrow"} & set(modules)


ROOM = r"/\S+: [\d.,]+ .?B are free; free some and run the same command again"


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ValueError("the video ends early"), WRONG, r"packuv: the video ends early\n"),
        (FileNotFoundError("no video cam03.mp4"), WRONG, r"packuv: no video cam03\.mp4\n"),
        (PermissionError(13, "Permission denied", "runs"), WRONG, r"packuv: Permission denied: runs\n"),
        (KeyboardInterrupt(), INTERRUPTED, r"packuv: stopped; the same command begins anew\n"),
        (TypeError("a bug\nin two lines"), FAILED, r"packuv: a bug in two lines; the traceback is in (\S+)\n"),
        (OSError(28, "No space left on device"), FAILED, rf"packuv: No space left on device: {ROOM}\n"),
        (OSError(122, "Disk quota exceeded", "a.mp4"), FAILED, rf"packuv: Disk quota exceeded: {ROOM}\n"),
        (OSError(28, "Error writing: [errno 28]", "a"), FAILED, rf"packuv: No space left on device: {ROOM}\n"),
        (OSError(28, "needs 9 MB, but 3 MB are free"), FAILED, r"packuv: needs 9 MB, but 3 MB are free\n"),
        (OSError(30, "Read-only file system", "runs"), FAILED, r"packuv: Read-only file system: runs\n"),
        (OSError(36, "File name too long", "runs"), WRONG, r"packuv: File name too long: runs\n"),
        (BrokenPipeError(32, "Broken pipe"), FAILED, r"packuv: Broken pipe\n"),
        (OSError(5, "Input/output error", "a.mp4"), FAILED, r"packuv: Input/output error: a\.mp4\n"),
    ],
)
def test_every_failure_is_one_line_and_a_code(error, code, message, capsys, monkeypatch, tmp_path):
    def fails(arguments):
        raise error

    monkeypatch.setattr(cli, "_load", lambda name: fails)
    monkeypatch.setattr(cli.tempfile, "tempdir", str(tmp_path))
    assert main(["doctor"]) == code
    found = re.fullmatch(message, capsys.readouterr().err)
    assert found
    if found.groups():
        log = next(tmp_path.iterdir())
        assert str(log) == found[1]
        assert "Traceback" in log.read_text()


@pytest.mark.parametrize("words", [["run", "capture", "--out", "runs"], ["fit", "capture", "--out", "runs"]])
def test_what_keeps_its_stages_goes_on_after_a_stop(words, capsys, monkeypatch):
    def stops(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_load", lambda name: stops)
    assert main(words) == INTERRUPTED
    assert capsys.readouterr().err == "packuv: stopped; the same command goes on from here\n"


def test_a_full_disk_takes_no_traceback_either(capsys, monkeypatch):
    def fails(arguments):
        raise TypeError("a bug")

    def full(*values, **settings):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cli, "_load", lambda name: fails)
    monkeypatch.setattr(cli.tempfile, "NamedTemporaryFile", full)
    assert main(["doctor"]) == FAILED
    assert capsys.readouterr().err == "packuv: a bug; no place for the traceback: No space left on device\n"


def test_a_full_disk_is_that_of_the_output_where_nothing_else_is_named(capsys, monkeypatch, tmp_path):
    def fails(arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cli, "_load", lambda name: fails)
    assert main(["sync", "capture", "--out", str(tmp_path / "runs")]) == FAILED
    assert capsys.readouterr().err.startswith(f"packuv: No space left on device: {tmp_path / 'runs'}: ")


def test_arguments_become_a_request(tmp_path):
    config = tmp_path / "settings.toml"
    config.write_text("[fit]\niterations = 100\nsh_degree = 1\n[keyframes]\nmin_separation = 9\n")
    words = ["fit", "capture", "--out", "runs", "--preset", "draft", "--frames", ":30", "--hold-out", "cam05, cam14"]
    words += ["--config", str(config), "--set", "fit.iterations=500", "--set", "fit.density.cap=9", "--jobs", "2"]
    assert request_from(parser().parse_args(words)) == RunRequest(
        capture=str(Path("capture").absolute()),
        out=str(Path("runs").absolute()),
        preset="draft",
        settings={
            "fit": {"iterations": "500", "sh_degree": 1, "density": {"cap": "9"}},
            "keyframes": {"min_separation": 9},
        },
        frames=":30",
        hold_out=("cam05", "cam14"),
        stop_after="fit",
        jobs=2,
    )


def test_what_times_are_worth_is_said_in_a_word() -> None:
    asked = request_from(
        parser().parse_args(["sync", "capture", "--out", "o", "--clock", "content", "--set", "sync.mutual=no"])
    )
    assert asked.settings == {"sync": {"clock": "content", "mutual": "no"}}


def test_settings_name_their_file_and_their_clashes(tmp_path):
    config = tmp_path / "settings.toml"
    config.write_text("fit = 3\n")
    with pytest.raises(ValueError, match=r"fit\.cap: fit is set to a value elsewhere, but is a table here"):
        read_settings(config, ["fit.cap=3"])
    config.write_text("[fit")
    with pytest.raises(ValueError, match=r"settings\.toml is no valid TOML"):
        read_settings(config, [])


def test_help_is_fast():
    start = time.monotonic()
    code = "from pipelines.cli import main; main(['--help'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "usage: packuv" in done.stdout
    # 0.2 s on a quiet machine; a heavy import would take seconds, a busy machine takes a few times more
    assert time.monotonic() - start < 3


def test_what_a_file_is_called_does_nothing_to_the_terminal(tmp_path, capsys):
    assert main(["info", str(tmp_path / "\x1b[2J\x07scene.mkv")]) == WRONG
    said = capsys.readouterr().err
    assert "\\x1b[2J\\x07scene.mkv" in said
    assert said[:-1].isprintable()
    assert main(["info", "a" * 10_000]) == WRONG
    assert len(capsys.readouterr().err) < 2_100


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--capture", "{}/none"], "no capture folder"),
        (["--host", "198.51.100.7"], "everyone who can reach 198.51.100.7 sees this scene"),
        (["--host", "198.51.100.7"], "--host must be an address of this machine"),
    ],
)
def test_view_says_who_may_look_and_what_is_not_there(words, message, tmp_path, capsys):
    path = write_wall(tmp_path / "scene.mkv", 0 * LIGHT)
    assert main(["view", str(path), *(word.format(tmp_path) for word in words)]) == 2
    assert message in capsys.readouterr().err
