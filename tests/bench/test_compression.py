"""Dead zones: what moves little stays where it is, what moves far goes there, and nobody comes or goes otherwise."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bench import compression
from bench.compression import NOUGHT, held, quiet
from packuv.gaussians.codes import OPACITY, REST, Codes
from packuv.gaussians.segment import Segment
from packuv.scene import Tolerance
from tests.support.small_scene import small_scene, small_segments


@pytest.mark.parametrize("tolerance", [Tolerance(), Tolerance(16, 1), Tolerance(64, 4)], ids=str)
def test_a_held_code_is_within_its_zone_and_moves_only_beyond_it(tolerance):
    segment = small_segments()[0]
    found, start = held(segment, tolerance), segment.key[segment.dynamic]
    assert (found.key is segment.key) or np.array_equal(found.key.xyz, segment.key.xyz)
    before = start.xyz, start.attributes
    for place, attributes, exact, other in zip(
        found.xyz, found.attributes, segment.xyz, segment.attributes, strict=True
    ):
        assert np.array_equal(attributes[:, OPACITY] > 0, other[:, OPACITY] > 0)
        for now, last, true, step in zip((place, attributes), before, (exact, other), tolerance.steps, strict=True):
            off, moved = np.abs(now.astype(int) - true), np.abs(now.astype(int) - last)
            assert off.max() <= 5 / 6 * step
            assert (off[moved > 0] == 0).all()
        before = place, attributes
    if tolerance.exact:
        assert np.array_equal(found.xyz, segment.xyz)
    else:
        assert (np.diff(found.attributes, axis=0) == 0).mean() > (np.diff(segment.attributes, axis=0) == 0).mean()


def test_bands_beside_nothing_become_nothing():
    segment = small_segments()[0]
    bands = np.tile(np.arange(NOUGHT - 3, NOUGHT + 4, dtype=np.uint8), (len(segment.key), 1))
    key = Codes(segment.key.xyz, np.concatenate([segment.key.attributes, bands], axis=1))
    none = segment.xyz[:0, :0], np.zeros((0, 0, key.attributes.shape[1]), np.uint8)
    found = quiet(Segment(0, key, np.zeros(len(key), bool), *none))
    assert np.array_equal(found.key.attributes[:, :REST], key.attributes[:, :REST])
    assert found.key.attributes[0, REST:].tolist() == [125, 126, 128, 128, 128, 130, 131]


def test_the_table_and_the_plot_have_every_row(tmp_path, capsys):
    scene, out, drawn = (tmp_path / name for name in ("scene.mkv", "r.json", "r.svg"))
    small_scene(scene)
    compression.main(["--scene", str(scene), "--out", str(out), "--plot", str(drawn), "--noises", "3e-8", "1e-7"])
    rows = {row["name"]: row for row in json.loads(out.read_text())["rows"]}
    printed, picture = capsys.readouterr().out, drawn.read_text()
    for name in rows:
        assert f"| {name} |" in printed
        assert f"<title>{name}</title>" in picture
    assert [picture.count(f">{line}</text>") for line in ("learned", "dead zone of changes", "fewer", "high")] == [
        1
    ] * 4
    for noise in ("3e-08", "1e-07"):
        plain, dead = rows[f"learned, noise {noise}"], rows[f"dead zone of changes, noise {noise}"]
        assert dead["bytes"] < plain["bytes"]
        assert dead["psnr_db"] < plain["psnr_db"]
        assert dead["track_bytes"]["key"] == plain["track_bytes"]["key"]
    assert not any("bands" in name for name in rows)
