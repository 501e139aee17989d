"""The store's promises: one build per recipe, nothing half-done, damage found."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.artefacts.digests import FileDigests, file_digest
from tasks.artefacts.recipe import OptionError, canonical, digest, plain, restore, write_json
from tasks.artefacts.store import RECEIPT, Building, Key, Store

scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4)
)


class Mode(StrEnum):
    FAST = "fast"
    EXACT = "exact"


@dataclass(frozen=True)
class Inner:
    rate: Fraction = Fraction(30)
    names: tuple[str, ...] = ()
    limits: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Options:
    count: int = 3
    step: float = 0.5
    mode: Mode = Mode.FAST
    layout: Literal["compact", "atlas"] = "compact"
    seed: int | None = None
    strict: bool = True
    inner: Inner = Inner()


options = st.builds(
    Options,
    count=st.integers(),
    step=st.floats(allow_nan=False, allow_infinity=False),
    mode=st.sampled_from(Mode),
    layout=st.sampled_from(["compact", "atlas"]),
    seed=st.none() | st.integers(),
    strict=st.booleans(),
    inner=st.builds(
        Inner, rate=st.fractions(), names=st.lists(st.sampled_from(["cam00", "cam01"]), max_size=3).map(tuple)
    ),
)


# --- recipes


@given(values)
def test_canonical_text_gives_the_value_back(value):
    back = json.loads(canonical(value))
    assert back == value
    assert canonical(back) == canonical(value)


@given(st.dictionaries(st.text(max_size=5), values, min_size=2, max_size=5))
def test_order_of_keys_does_not_matter(value):
    assert canonical(value) == canonical(dict(reversed(value.items())))


@given(options, options)
def test_recipes_are_equal_exactly_when_options_are(one, other):
    assert (digest(one) == digest(other)) == (one == other)


@given(options)
def test_restore_is_the_inverse_of_plain(value):
    assert restore(Options, plain(value)) == value
    assert restore(Options, json.loads(canonical(value))) == value


@given(values)
def test_restore_of_anything_is_options_or_one_clear_error(value):
    try:
        assert isinstance(restore(Options, value), Options)
    except OptionError as error:
        assert str(error).startswith(("options", "unknown option"))  # noqa: PT017 - either outcome is right, another error is not


@pytest.mark.parametrize("value", [float("nan"), float("inf"), Path("x"), {1: 2}, b"x", object(), [{"a": {1}}]])
def test_recipe_refuses_what_has_no_one_text(value):
    with pytest.raises(TypeError, match=r"^recipe"):
        canonical(value)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"cuont": 1}, "unknown option options.cuont; valid here: count, step, mode, layout, seed, strict, inner"),
        ({"inner": {"rat": 1}}, "unknown option options.inner.rat; valid here: rate, names, limits"),
        ({"count": "many"}, "options.count must be a whole number, but is 'many'"),
        ({"count": 1.5}, "options.count must be a whole number, but is 1.5"),
        ({"count": True}, "options.count must be a whole number, but is True"),
        ({"step": "nan"}, "options.step must be a finite number, but is 'nan'"),
        ({"mode": "slow"}, "options.mode must be one of fast, exact, but is 'slow'"),
        ({"layout": "web"}, "options.layout must be one of compact, atlas, but is 'web'"),
        ({"strict": "maybe"}, "options.strict must be true or false, but is 'maybe'"),
        ({"inner": {"limits": "1"}}, "options.inner.limits must have 2 values, but has 1: '1'"),
        ({"inner": 3}, "options.inner must be a table of rate, names, limits, but is 3"),
    ],
)
def test_option_errors_name_the_path(value, message):
    with pytest.raises(OptionError) as caught:
        restore(Options, value)
    assert str(caught.value) == message


def test_text_is_read_by_the_declared_type():
    given_text = {"count": "7", "step": "2", "mode": "exact", "seed": "none", "strict": "off"}
    given_text["inner"] = {"names": "cam00, cam01", "limits": "0.1,0.9", "rate": "30000/1001"}
    expected = Options(7, 2.0, Mode.EXACT, strict=False)
    expected = replace(expected, inner=Inner(Fraction(30000, 1001), ("cam00", "cam01"), (0.1, 0.9)))
    assert restore(Options, given_text) == expected


# --- store


def writes(text: str, calls: list[str]):
    def build(building: Building):
        calls.append(text)
        (building.out / "sub").mkdir()
        (building.out / "sub" / "data.txt").write_text(text)
        return {"lines": 1}

    return build


def test_same_recipe_builds_once_and_any_change_builds_again(tmp_path):
    store, calls = Store(tmp_path), []
    first = store.make("fit", 1, Options(), {"groups": "a"}, writes("one", calls))
    again = store.make("fit", 1, Options(), {"groups": "a"}, writes("two", calls))
    assert (first, first.reused, again.reused) == (again, False, True)
    assert (store.path(first) / "sub/data.txt").read_text() == "one"
    for change in [
        ("fit", 2, Options(), {"groups": "a"}),
        ("fit", 1, Options(count=4), {"groups": "a"}),
        ("fit", 1, Options(), {"groups": "b"}),
        ("flow", 1, Options(), {"groups": "a"}),
        ("fit", 1, Options(), {"groups": first}),
    ]:
        assert store.find(*change) is None
        assert store.make(*change, writes("more", calls)) != first
        assert store.find(*change).reused
    assert calls == ["one"] + ["more"] * 5


def test_receipt_tells_what_was_made_and_how(tmp_path):
    store = Store(tmp_path)
    key = store.make("fit", 1, Options(), {}, writes("text", []))
    receipt = store.receipt(key)
    assert receipt.outputs == {
        "sub/data.txt": {"sha256": file_digest(store.path(key) / "sub/data.txt"), "bytes": len("text")}
    }
    assert receipt.recipe["options"] == plain(Options())
    assert receipt.notes == {"lines": 1}
    assert receipt.size_bytes == 4
    assert receipt.peak_memory_bytes > 1 << 20
    assert digest(receipt.recipe) == key.digest
    assert list(store.keys()) == [key]


def test_failed_build_publishes_nothing_and_keeps_its_scratch(tmp_path):
    store = Store(tmp_path)

    def fails(building: Building):
        (building.out / "half.txt").write_text("half")
        (building.scratch / "checkpoint.txt").write_text("frame 7")
        raise ValueError("the video ends early")

    def resumes(building: Building):
        assert not list(building.out.iterdir())
        (building.out / "whole.txt").write_text((building.scratch / "checkpoint.txt").read_text())

    with pytest.raises(ValueError, match="ends early"):
        store.make("fit", 1, None, {}, fails)
    assert store.find("fit", 1, None, {}) is None
    assert list(store.keys()) == []
    key = store.make("fit", 1, None, {}, resumes)
    assert sorted(path.name for path in store.path(key).iterdir()) == [RECEIPT, "whole.txt"]
    assert (store.path(key) / "whole.txt").read_text() == "frame 7"
    assert not store.work_folder(key).exists()


def test_an_error_of_the_system_names_a_place(tmp_path):
    store = Store(tmp_path)

    def build(building: Building) -> None:
        with open("/dev/full", "w") as file:  # writing fails without a name
            file.write("x")

    with pytest.raises(OSError, match="No space left on device") as caught:
        store.make("a", 1, {}, {}, build)
    assert caught.value.filename == str(store.work_folder(store.key("a", 1, {}, {})))
    assert list(store.keys()) == []


def test_json_that_cannot_be_written_leaves_the_old_one(tmp_path):
    write_json(tmp_path / "run.json", {"a": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_json(tmp_path / "run.json", {"a": "b" * 200})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.filename == str(tmp_path / "run.json")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
    assert json.loads((tmp_path / "run.json").read_text()) == {"a": 1}


def test_missing_artefact_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no artefact fit/00; run the stage 'fit' first"):
        Store(tmp_path).path(Key("fit", "00"))


@pytest.mark.parametrize("harm", ["delete", "shorten", "receipt"])
def test_artefact_that_lost_something_is_built_again(tmp_path, harm):
    store, calls = Store(tmp_path), []
    file = store.path(store.make("fit", 1, None, {}, writes("text", calls))) / "sub/data.txt"
    match harm:
        case "delete":
            file.unlink()
        case "shorten":
            file.write_text("te")
        case "receipt":
            (file.parents[1] / RECEIPT).unlink()
    store.make("fit", 1, None, {}, writes("text", calls))
    assert len(calls) == 2
    assert file.read_text() == "text"


def test_verify_finds_every_kind_of_damage(tmp_path):
    store = Store(tmp_path)
    keys = [store.make("fit", 1, number, {}, writes("text", [])) for number in range(4)]
    assert store.verify() == []
    (store.path(keys[0]) / "sub/data.txt").write_text("tExt")
    (store.path(keys[1]) / "sub/data.txt").unlink()
    receipt = store.path(keys[2]) / RECEIPT
    receipt.write_text(receipt.read_text().replace('"version": 1', '"version": 2'))
    found = {(damage.key.digest, damage.path, damage.reason) for damage in store.verify()}
    assert found == {
        (keys[0].digest, "sub/data.txt", "differs from what the stage wrote"),
        (keys[1].digest, "sub/data.txt", "is missing"),
        (keys[2].digest, RECEIPT, "does not hold the recipe that names this folder"),
    }


@pytest.mark.parametrize(
    "damaged",
    [
        lambda text: b"",
        lambda text: text[:-20],
        lambda text: text.replace(b'"outputs"', b'"outputz"'),
        lambda text: text.replace(b'"bytes"', b'"bytez"'),
        lambda text: text.replace(b'"recipe": {', b'"recipe": 1, "n": {'),
        lambda text: text.replace(b'"fit"', b'"fi\xff"'),
        lambda text: b"[]",
    ],
)
def test_an_artefact_whose_receipt_is_damaged_is_named_and_made_again(tmp_path, damaged):
    store, log = Store(tmp_path), list[str]()
    other = store.make("fit", 1, 2, {}, writes("text", log))
    key = store.make("encode", 1, 3, {"fit": other}, writes("text", log))
    for which in (key, other):
        receipt = store.path(which) / RECEIPT
        receipt.write_bytes(damaged(receipt.read_bytes()))
    assert {(damage.key, damage.path) for damage in store.verify()} == {(key, RECEIPT), (other, RECEIPT)}
    assert store.absent() == set()
    assert not store.holds(key)
    with pytest.raises(ValueError, match=rf"{RECEIPT} must be a receipt as a store writes it, but is damaged"):
        store.receipt(key)
    assert not store.make("fit", 1, 2, {}, writes("text", log)).reused
    assert not store.make("encode", 1, 3, {"fit": other}, writes("text", log)).reused
    assert store.verify() == []


RACER = """
import os, sys, time
from tasks.artefacts.store import Store

root, log = sys.argv[1:]
def build(building):
    with open(log, "a") as file:
        file.write(f"{os.getpid()}\\n")
    time.sleep(0.3)
    (building.out / "data.txt").write_text("x")

sys.stdin.readline()
Store(root).make("fit", 1, None, {}, build)
"""


def test_racing_processes_build_once(tmp_path):
    log = tmp_path / "log"
    # Fresh processes: a fork of this one would carry the threads of whatever tests ran before.
    command = [sys.executable, "-c", RACER, str(tmp_path / "store"), str(log)]
    racers = [subprocess.Popen(command, stdin=subprocess.PIPE, text=True) for _ in range(3)]
    for racer in racers:
        assert racer.stdin is not None
        racer.stdin.write("go\n")
        racer.stdin.flush()
    assert [racer.wait(60) for racer in racers] == [0, 0, 0]
    for racer in racers:
        assert racer.stdin is not None
        racer.stdin.close()
    assert len(log.read_text().splitlines()) == 1
    assert Store(tmp_path / "store").verify() == []


RESUMABLE = """
import sys, time
from pathlib import Path
from tasks.artefacts.store import Store

def build(building):
    for step in range(5):
        mark = building.scratch / f"{step}.txt"
        if not mark.exists():
            print("step", step, flush=True)
            time.sleep(0.05)
            mark.write_text(str(step * step))
    (building.out / "sum.txt").write_text("+".join((building.scratch / f"{s}.txt").read_text() for s in range(5)))

Store(sys.argv[1]).make("fit", 1, None, {}, build)
print("finished", flush=True)
"""


def test_killed_build_resumes_with_its_scratch(tmp_path):
    command = [sys.executable, "-c", RESUMABLE, str(tmp_path)]
    steps: list[str] = []
    while True:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            lines = [process.stdout.readline().strip(), process.stdout.readline().strip()]
            if lines[-1] not in ("finished", ""):
                process.send_signal(signal.SIGKILL)  # in the middle of the second step of this attempt
        steps += [line for line in lines if line.startswith("step")]
        if process.returncode == 0:
            break
    store = Store(tmp_path)
    (key,) = store.keys()
    assert (store.path(key) / "sum.txt").read_text() == "0+1+4+9+16"
    assert process.returncode == 0
    assert steps[:2] == ["step 0", "step 1"]
    assert steps.count("step 0") == 1  # what was finished before a kill is not done again
    assert len(steps) > 5  # a kill did cost the step under way
    assert store.verify() == []


def test_finished_work_is_not_done_again_after_a_kill_before_publication(tmp_path, monkeypatch):
    store, calls = Store(tmp_path), []

    def dies(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Store, "_publish", dies)
        with pytest.raises(KeyboardInterrupt):
            store.make("fit", 1, None, {}, writes("text", calls))
    assert store.find("fit", 1, None, {}) is None
    key = store.make("fit", 1, None, {}, writes("text", calls))
    assert calls == ["text"]
    assert store.receipt(key).notes == {"lines": 1}
    assert store.verify() == []


# --- digests of files


def test_digests_are_remembered_and_change_with_content(tmp_path, monkeypatch):
    monkeypatch.setattr("tasks.artefacts.digests.SETTLED_SECONDS", 0)
    file = tmp_path / "cam00.mp4"
    file.write_bytes(b"one")
    digests = FileDigests(tmp_path / "memory" / "digests.json")
    first, stat = digests({"cam00": file}), file.stat()
    assert first == {"cam00": file_digest(file)}
    digests.path.write_text(digests.path.read_text().replace(first["cam00"], "remembered"))
    assert digests({"cam00": file}) == {"cam00": "remembered"}
    file.write_bytes(b"two")
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    # Size, time of modification and inode are the same, as when a hidden change is restored: the time of change tells.
    assert digests({"cam00": file}) == {"cam00": file_digest(file)} != first


def test_a_file_written_just_now_is_not_remembered(tmp_path):
    file = tmp_path / "cam00.mp4"
    digests = FileDigests(tmp_path / "digests.json")
    file.write_bytes(b"one")
    first = digests({"cam00": file})
    stat = file.stat()
    file.write_bytes(b"two")
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert digests({"cam00": file}) != first


def test_damaged_memory_is_no_harm(tmp_path):
    file = tmp_path / "cam00.mp4"
    file.write_bytes(b"one")
    digests = FileDigests(tmp_path / "digests.json")
    digests.path.write_text('{"half')
    assert digests({"cam00": file}) == {"cam00": file_digest(file)}
    with pytest.raises(FileNotFoundError, match=r"no file .*cam01\.mp4"):
        digests({"cam01": tmp_path / "cam01.mp4"})


def test_threads_that_write_one_file_leave_it_whole(tmp_path):
    path = tmp_path / "file_digests.json"
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda number: write_json(path, {"number": number}), range(400)))
    assert json.loads(path.read_text())["number"] in range(400)
    assert list(tmp_path.iterdir()) == [path]
