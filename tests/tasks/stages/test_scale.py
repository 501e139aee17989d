"""The stage that brings a rig to metres: what it makes of a capture, and what it says where that cannot be."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.accept import CheckOptions, check_rig
from calibration.board import Board
from calibration.rig import Rig
from calibration.scale import Distance, ScaleOptions, scaled
from sync.align import AlignOptions
from sync.capture import find_capture
from tasks.artefacts.stage import Files, Site
from tasks.stages.calibrate import CHECK, MATCHES
from tasks.stages.footage import RIG, Take
from tasks.stages.scale import SCALE, Known, ScaleRig, _rounds, known_of
from tasks.stages.synchronize import Synchronize
from tests.support.artefacts import build_here, put
from tests.support.boards import board_pose, show
from tests.support.calibration_scene import ring

BOARD = Board(kind="charuco", columns=8, rows=5, square=0.12, marker=0.09)  # type: ignore[arg-type]  # text, as a file has it
TABLE = '[board]\nkind = "charuco"\ncolumns = 8\nrows = 5\nsquare = 0.12\nmarker = 0.09\n'
LYING = board_pose((0.1, 0.0, 0.05), (0, -1, 0), 20)
SCALE_TOLERANCE, UP_TOLERANCE_DEG = 0.005, 0.5
METRES_PER_UNIT = 0.4


def room() -> Rig:
    return ring(4, radius=2.2, height=-1.6, size=(960, 540))


def capture_of(folder: Path, instants: Sequence[Mapping[str, np.ndarray]], settings: str = "fps = 30\n") -> Path:
    """A capture of picture folders."""
    for number, pictures in enumerate(instants):
        for name, picture in pictures.items():
            (folder / "videos" / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / "videos" / name / f"{number:06d}.png"), picture[:, :, ::-1])
    (folder / "capture.toml").write_text(settings)
    return folder


def blank() -> dict[str, np.ndarray]:
    return {name: np.full((540, 960, 3), 90, np.uint8) for name in room().names}


def stage_of(site: Site, tmp_path: Path, known: Known, *, rig: Rig | None = None) -> ScaleRig:
    """On the room's rig, whose unit is not a metre."""
    rig = rig or replace(scaled(room(), 1 / METRES_PER_UNIT), metric=False)
    files = Files(dict.fromkeys(find_capture(site.capture).videos, "content"))
    sync = Synchronize(videos=files, timecodes=Files({}), fps=None, timecode_column=None, options=AlignOptions())
    sync = replace(sync, fps=find_capture(site.capture).settings.fps)
    _, made = build_here(sync, site, tmp_path / "sync")
    groups = put(site, "sync", lambda out: [path.rename(out / path.name) for path in made.iterdir()])

    def fill(out: Path) -> None:
        rig.save(out / RIG)
        report = replace(check_rig(rig), suspicious={"cam03": "was odd before"})
        (out / CHECK).write_text(json.dumps(report.to_json()))
        (out / MATCHES).write_text('{"matches": 1}')

    take = Take(groups=groups, rig=put(site, "rig", fill), cameras=rig.names)
    return ScaleRig(take=take, first=0, known=known, check=CheckOptions(), options=ScaleOptions())


def test_a_board_on_the_floor_brings_the_rig_to_metres(tmp_path):
    seen = show(room(), BOARD, LYING)
    site = Site(tmp_path / "store", capture_of(tmp_path / "capture", [blank(), seen, seen, seen, seen]), 1)
    known = Known(board=BOARD, distances=(Distance(("cam00", "cam01"), 2.0),), up="board")
    notes, out = build_here(stage_of(site, tmp_path, known), site, tmp_path / "scale")
    rig, truth = Rig.load(out / RIG), room()
    assert rig.metric
    assert notes["metres_per_unit"] == pytest.approx(METRES_PER_UNIT, rel=SCALE_TOLERANCE)
    assert np.allclose(rig.centres, truth.centres, rtol=SCALE_TOLERANCE, atol=1e-6)
    assert rig.up is not None
    assert np.degrees(np.arccos(min(1.0, -rig.up[1]))) < UP_TOLERANCE_DEG
    assert "a unit of it is 0.39" in rig.source
    assert "up by the board on the floor (4 instants)" in rig.source
    check = json.loads((out / CHECK).read_text())
    assert check["suspicious"]["cam03"] == "was odd before"
    assert "is 0.39" in check["suspicious"]["scale"]  # the distance of 2 m is a lie: they are 3.1 m apart
    assert "the board is believed" in check["suspicious"]["scale"]
    assert check["rig_radius"] == pytest.approx(np.hypot(2.2, 1.6), rel=0.01)
    assert (out / MATCHES).read_text() == '{"matches": 1}'
    told = json.loads((out / SCALE).read_text())
    assert told["board"]["instants"] == 4
    assert told["distance"]["metres_per_unit"] == pytest.approx(2 / np.linalg.norm(
        scaled(truth, 1 / METRES_PER_UNIT)["cam00"].centre - scaled(truth, 1 / METRES_PER_UNIT)["cam01"].centre
    ))  # fmt: skip
    again = build_here(stage_of(site, tmp_path, known), site, tmp_path / "again")[1]
    assert all((again / name).read_bytes() == (out / name).read_bytes() for name in (RIG, CHECK, MATCHES, SCALE))


def test_a_rig_in_metres_that_the_board_refutes_is_a_finding(tmp_path):
    seen = show(room(), BOARD, LYING)
    site = Site(tmp_path / "store", capture_of(tmp_path / "capture", [seen] * 4), 1)
    rig = replace(scaled(room(), 1.1), metric=True, source="calibration.csv")
    _, out = build_here(stage_of(site, tmp_path, Known(board=BOARD), rig=rig), site, tmp_path / "scale")
    said = json.loads((out / CHECK).read_text())["suspicious"]["scale"]
    assert said.startswith("one unit is a metre by calibration.csv, but 0.90")
    assert np.allclose(Rig.load(out / RIG).centres, room().centres, rtol=SCALE_TOLERANCE, atol=1e-6)
    assert Rig.load(out / RIG).up is None


def test_a_direction_alone_leaves_the_scale_as_it_is(tmp_path):
    site = Site(tmp_path / "store", capture_of(tmp_path / "capture", [blank()] * 2), 1)
    stage = stage_of(site, tmp_path, Known(up=(0.0, -3.0, 4.0)))
    given = Rig.load(stage_path(site, stage) / RIG)
    _, out = build_here(stage, site, tmp_path / "told")
    rig = Rig.load(out / RIG)
    assert rig.up == pytest.approx((0, -0.6, 0.8))
    assert not rig.metric
    assert np.array_equal(rig.centres, given.centres)
    _, out = build_here(replace(stage, known=Known(up="cameras")), site, tmp_path / "cameras")
    assert Rig.load(out / RIG).up == pytest.approx((0, -1, 0), abs=1e-9)


def stage_path(site: Site, stage: ScaleRig) -> Path:
    assert stage.take.rig is not None
    return site.path(stage.take.rig)


@pytest.mark.parametrize(
    ("shown", "board", "message"),
    [
        (
            (),
            BOARD,
            r"board of 8 x 5 \(5X5_100\), but it is not seen in 12 pictures from instant 0 on; film it",
        ),
        (
            ("cam01",),
            BOARD,
            "no two cameras locate its corners at one instant: it is seen by cam01 in 3, in 12 pictures",
        ),
        (
            ("cam00", "cam01"),
            replace(BOARD, columns=5, rows=8),
            "none of its corners is seen, although up to [12]. markers of 5X5_100 are",
        ),
    ],
    ids=["nowhere", "by one camera", "another board"],
)
def test_a_board_that_tells_nothing_ends_the_run_with_what_was_looked_at(tmp_path, shown, board, message):
    seen = {name: picture for name, picture in show(room(), BOARD, LYING).items() if name in shown}
    site = Site(tmp_path / "store", capture_of(tmp_path / "capture", [{**blank(), **seen}] * 3), 1)
    with pytest.raises(ValueError, match=message):
        build_here(stage_of(site, tmp_path, Known(board=board)), site, tmp_path / "scale")


def test_more_instants_are_looked_at_while_too_few_show_it():
    options = ScaleOptions(instants=4, most_instants=16)
    rounds = list(_rounds(10, 40, options))
    assert rounds[0] == [10, 20, 30, 40]
    assert len(rounds) == 3
    every = [instant for one in rounds for instant in one]
    assert len(set(every)) == len(every)
    assert list(_rounds(0, 2, options)) == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TABLE.replace("8", "1"), r"capture\.toml: \[board\]: columns and rows must be 2 to 100"),
        (TABLE + "name = 'a'", r"\[board\]: unknown key 'name'"),
        ('distance = { cameras = ["cam00", "cam9"], metres = 1 }', "distance names 'cam9', which has no video"),
        ('distance = { cameras = ["cam00"], metres = 1 }', "distance must be between two cameras, as"),
        ("distance = []", "distance must be a table, but is"),
        ("board = 3", "board must be a table, but is 3"),
        ("up = 'board'", r"up = 'board' needs a \[board\] that lies on the floor"),
        ("up = 'north'", r"up must be 'board' or 'cameras' or a direction \[x, y, z\] other than 0, but is 'north'"),
        ("up = [0, 0, 0]", "up must be"),
        ("up = [0, true, 0]", "up must be"),
        ("up = [0, 0, 1]", "up is a direction in the calibration's world, but here COLMAP solves the cameras"),
        (f"rig_from = 'take01'\n{TABLE}", "but this one comes from rig_from; write them into"),
    ],
)
def test_what_capture_toml_says_wrong_is_named(tmp_path, text, message):
    capture_of(tmp_path, [{name: picture[:8, :8] for name, picture in blank().items()}], f"fps = 30\n{text}")
    with pytest.raises(ValueError, match=message):
        known_of(find_capture(tmp_path))


def test_what_capture_toml_knows_is_read(tmp_path):
    pictures = {name: picture[:8, :8] for name, picture in blank().items()}
    capture_of(tmp_path, [pictures])
    assert not known_of(find_capture(tmp_path))
    text = f'up = "board"\ndistance = {{ cameras = ["cam00", "cam02"], metres = 2.35 }}\n{TABLE}'
    capture_of(tmp_path, [pictures], text)
    known = known_of(find_capture(tmp_path))
    assert known == Known(board=BOARD, distances=(Distance(("cam00", "cam02"), 2.35),), up="board")
    (tmp_path / "calibration").mkdir()
    room().save(tmp_path / "calibration" / "rig.json")
    (tmp_path / "capture.toml").write_text("up = [0, -1, 0.5]")
    assert known_of(find_capture(tmp_path)).up == (0, -1, 0.5)
