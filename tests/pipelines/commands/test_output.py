"""What is printed never stops the work, and the exit code tells the truth."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.commands.output import Outlet, answer, lasting_output
from tests.pipelines.commands.test_exchange import write_small_scene
from tests.support.places import ROOT

PACKUV = f"{sys.executable} -c 'import sys; from pipelines.cli import main; sys.exit(main())'"
FULL = "cannot write to standard output: No space left on device"


def shell(line: str) -> tuple[int, str]:
    """Exit code of the first command of a pipeline in bash, and what came on its standard error."""
    script = f"{line}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", script], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    return done.returncode, done.stderr


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "small.mkv"
    write_small_scene(path)
    return path


@pytest.mark.parametrize("words", ["--help", "info {scene}", "info {scene} --json", "verify {scene}"])
@pytest.mark.parametrize(
    "streams", ["| true", "| head -1", ">&-", "2>&-", "<&-", "<&- >&- 2>&-", "2> /dev/full", "2>&1 | true"]
)
def test_nobody_listens_is_no_failure(scene, words, streams):
    assert shell(f"{PACKUV} {words.format(scene=scene)} {streams}") == (0, "")


@pytest.mark.parametrize("words", ["--version", "info {scene}", "info {scene} --json", "verify {scene}", "doctor"])
def test_an_answer_that_a_full_disk_did_not_take_is_a_failure(scene, words):
    assert shell(f"{PACKUV} {words.format(scene=scene)} > /dev/full") == (1, f"packuv: {FULL}\n")


def test_an_answer_and_its_sentence_on_one_full_disk(scene):
    assert shell(f"{PACKUV} info {scene} > /dev/full 2>&1") == (1, "")


@pytest.mark.parametrize("streams", ["2> /dev/full", "2>&-", ">&- 2>&-", "2>&1 | true"])
def test_bad_input_keeps_its_code_where_nobody_hears_of_it(streams):
    assert shell(f"{PACKUV} info nowhere.mkv {streams}") == (2, "")


def test_what_is_written_beside_the_streams_does_not_land_in_files(tmp_path):
    """Native code prints to descriptor 1, which would otherwise be that of the first file that is opened."""
    code = (
        "import os, sys; from pipelines import cli\n"
        f"def work(arguments):\n file = open({str(tmp_path / 'a')!r}, 'w'); os.write(1, b'x'); os.write(2, b'x')\n"
        " file.close(); return 0\n"
        "cli._load = lambda name: work; sys.exit(cli.main(['doctor']))"
    )
    assert shell(f'{sys.executable} -c "{code}" <&- >&- 2>&-') == (0, "")
    assert (tmp_path / "a").read_text() == ""


def dead(kind: str) -> io.TextIOWrapper:
    """A stream that takes nothing."""
    if kind == "full":
        return open("/dev/full", "w")
    if kind == "closed":
        with open(os.devnull, "w") as stream:
            return stream
    reader, writer = os.pipe()
    os.close(reader)
    return open(writer, "w")


@pytest.mark.parametrize("kind", ["full", "closed", "pipe"])
@given(texts=st.lists(st.text(st.characters(exclude_categories=[])), max_size=4))
def test_an_outlet_takes_every_text(kind, texts):
    stream = dead(kind)
    outlet = Outlet(stream)
    assert [outlet.write(text) for text in texts] == [len(text) for text in texts]
    outlet.flush()
    assert not outlet.isatty()
    stream.close()  # which would raise if anything were held back


@given(st.text(st.characters(exclude_categories=[])))
def test_a_living_stream_gets_what_it_can_spell(text):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="latin-1", newline="")
    Outlet(stream).write(text)
    stream.flush()
    written = stream.buffer.getvalue().decode("latin-1")
    assert written in (text, text.encode("ascii", "backslashreplace").decode())


@pytest.mark.parametrize(("kind", "fails"), [("full", True), ("closed", False), ("pipe", False)])
def test_only_a_disk_fails_an_answer(kind, fails, monkeypatch):
    monkeypatch.setattr(sys, "stdout", dead(kind))
    with lasting_output():
        if fails:
            with pytest.raises(OSError, match=FULL) as caught:
                answer("facts")
            assert caught.value.errno == errno.ENOSPC
        else:
            answer("facts")
    assert not isinstance(sys.stdout, Outlet)
    if not sys.stdout.closed:
        sys.stdout.close()


def test_a_missing_stream_is_none(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with lasting_output():
        answer("facts")
        with pytest.raises(io.UnsupportedOperation):
            sys.stdout.fileno()
    assert sys.stdout is None
