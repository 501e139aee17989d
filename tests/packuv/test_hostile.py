"""No scene file, splat file or camera file can hurt the program: it is read, or refused in one sentence and in time."""

import json
import os
import subprocess
import sys

import pytest

import calibration.rig
from packuv import bounds
from tests.support.hostile import find_trouble, make_scene, read_scene, splat_files, trouble, write_worst
from tests.support.places import ROOT


@pytest.mark.parametrize("seed", range(3))
def test_files_changed_anywhere_are_read_or_refused_in_one_sentence(tmp_path, seed):
    assert find_trouble(tmp_path, seed=seed, count=25) == []


def test_what_is_changed_was_valid(tmp_path):
    make_scene(tmp_path / "a.mkv")
    read_scene(tmp_path / "a.mkv")
    for suffix, content in splat_files(tmp_path).items():
        (tmp_path / f"b{suffix}").write_bytes(content)
        assert not trouble(tmp_path / f"b{suffix}")


def test_the_worst_files_take_neither_time_nor_memory(tmp_path):
    write_worst(tmp_path)
    count = len(list(tmp_path.iterdir()))
    command = [sys.executable, "-m", "tests.support.hostile", "--worst", "--folder", tmp_path]
    # One arena: those that threads reserve are address space, not memory.
    environment = {**os.environ, "MALLOC_ARENA_MAX": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"refused": count, "trouble": {}}


def test_a_rig_has_the_same_bounds():
    """The two packages do not know each other."""
    ours = bounds.MOST_SIDE_PX, bounds.MOST_PIXELS
    assert ours == (calibration.rig.MOST_SIDE_PX, calibration.rig.MOST_PIXELS)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("1/0", "rate must be a fraction above 0"),
        ("1e9", "rate must be a fraction above 0"),
        ("-1/1", "rate must be a fraction above 0"),
        (30, "rate must be a fraction above 0"),
        (f"{2**31}/1", "both parts up to 2147483647"),
    ],
)
def test_a_rate_is_two_whole_numbers(value, message):
    with pytest.raises(ValueError, match=message):
        bounds.rate_of(value, "rate")


def test_depth_is_that_of_lists_and_objects():
    def nested(depth):
        return {"a": nested(depth - 1)} if depth else 1

    bounds.check_depth(nested(bounds.MOST_JSON_DEPTH), "it")
    with pytest.raises(ValueError, match="it is nested more than 64 deep"):
        bounds.check_depth(nested(bounds.MOST_JSON_DEPTH + 1), "it")


def test_the_header_of_the_longest_scene_fits():
    """A frame's time, digest, size, checksum, prediction, form, light, and their commas; a segment for 30 of them."""
    steady = f'{10**18},"{"f" * 32}",{10**7},{2**32 - 1},2,1,'
    lit = f"{steady}{'-1000000,' * 3}"
    segment = json.dumps(dict.fromkeys(("differences", "dynamic", "first", "first_packet"), 10**6)) * 3
    for frames, frame in ((bounds.MOST_FRAMES, steady), (bounds.MOST_LIT_FRAMES, lit)):
        assert frames * (len(frame) + len(segment) / 30) < bounds.MOST_JSON_BYTES
        assert frames * (frame.count(",") + segment.count(",") / 30) < bounds.MOST_JSON_VALUES
