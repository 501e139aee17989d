"""SOG: archives and folders written here, by the format's specification, are read within their steps."""

from __future__ import annotations

import json
import zipfile

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.interchange import read_gaussians, read_sog
from tests.support.splats import alpha_of, random_gaussians, rotation_error

WIDTH = 8
ROTATION = 0.0081  # three components of 8 bits over sqrt(2): half a step each, and the largest makes up for them


def webp(texels):
    """Lossless WebP of [n, 3 or 4] r g b a, filled up to whole rows with 255."""
    texels = np.concatenate([texels, np.full((len(texels), 4 - texels.shape[1]), 255)], axis=1).astype(np.uint8)
    rows = -(-len(texels) // WIDTH)
    picture = np.full((rows * WIDTH, 4), 255, np.uint8)
    picture[: len(texels)] = texels
    return encoded(picture.reshape(rows, WIDTH, 4))


def encoded(picture):
    ok, content = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert ok
    return content.tobytes()


def indices(book, values):
    return np.abs(np.asarray(book) - values[..., None]).argmin(axis=-1)


def sog(gaussians, version=2):
    """The files of a scene, and the codebook that all its values come from, by name."""
    n, book = len(gaussians), np.linspace(-4, 4, 256)
    t = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means))
    low, high = t.min(axis=0) - 1e-3, t.max(axis=0) + 1e-3
    position = np.rint((t - low) / (high - low) * 65535).astype(np.int64)
    largest = np.abs(gaussians.quaternions).argmax(axis=1)
    rows = np.arange(n)
    q = gaussians.quaternions * np.sign(gaussians.quaternions[rows, largest])[:, None]
    others = np.array([np.delete(row, k) for row, k in zip(q, largest, strict=True)])
    rotation = np.concatenate([np.rint((others / np.sqrt(2) + 0.5) * 255), 252 + largest[:, None]], axis=1)
    alpha = np.rint(alpha_of(gaussians)[:, None] * 255)
    ranged = {"codebook": book.tolist()} if version == 2 else {"mins": [-4.0] * 4, "maxs": [4.0] * 4}
    opacity = alpha if version == 2 else indices(book, gaussians.opacity_logits[:, None])
    meta = {
        "version": version,
        "count": n,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {**ranged, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {**ranged, "files": ["sh0.webp"]},
    }
    if version == 1:
        del meta["version"], meta["count"]
        meta["means"]["shape"] = [n, 3]
    files = {
        "means_l.webp": webp(position & 255),
        "means_u.webp": webp(position >> 8),
        "quats.webp": webp(rotation),
        "scales.webp": webp(indices(book, gaussians.log_scales)),
        "sh0.webp": webp(np.concatenate([indices(book, gaussians.sh[:, 0]), opacity], axis=1)),
    }
    if gaussians.sh_degree:
        coefficients = gaussians.sh.shape[1] - 1
        palette = np.zeros((-(-n // 64) * 64, coefficients, 4), np.uint8)
        palette[:n, :, :3], palette[..., 3] = indices(book, gaussians.sh[:, 1:]), 255
        label = np.arange(n)[::-1]  # in another order, so that labels matter
        palette[:n, :, :3] = palette[:n, :, :3][::-1]
        files["shN_centroids.webp"] = encoded(palette.reshape(-1, 64 * coefficients, 4))
        files["shN_labels.webp"] = webp(np.stack([label & 255, label >> 8], axis=1))
        meta["shN"] = {"bands": gaussians.sh_degree, "codebook": book.tolist(), "count": n}
        meta["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    return {"meta.json": json.dumps(meta).encode(), **files}


def write_archive(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def write_folder(folder, files):
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 300), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_archives_and_folders_are_read_within_their_steps(tmp_path, count, degree, seed):
    truth = random_gaussians(count, degree, seed)
    files = sog(truth)
    write_archive(tmp_path / "a.sog", files)
    write_folder(tmp_path / "a", files)
    back = read_gaussians(tmp_path / "a.sog")
    assert (len(back), back.sh_degree) == (count, degree)
    # Half a step of 16 bits over the range of the symmetric logarithm, times its slope 1 + |x|.
    span = np.ptp(np.sign(truth.means) * np.log1p(np.abs(truth.means)), axis=0) + 2e-3
    assert (np.abs(back.means - truth.means) <= (1 + np.abs(truth.means)) * span * 0.51 / 65535 + 1e-6).all()
    step = 0.501 * 8 / 255
    assert np.abs(back.log_scales - np.clip(truth.log_scales, -4, 4)).max() <= step
    assert np.abs(back.sh - np.clip(truth.sh, -4, 4)).max() <= step
    assert np.abs(alpha_of(back) - alpha_of(truth)).max() <= 0.501 / 255
    assert rotation_error(back, truth).max() < ROTATION
    for other in (tmp_path / "a", tmp_path / "a" / "meta.json"):
        assert np.array_equal(read_gaussians(other).sh, back.sh)


def test_version_1_has_ranges_and_logits(tmp_path):
    truth = random_gaussians(40, 0)
    write_archive(tmp_path / "a.sog", sog(truth, version=1))
    back = read_sog(tmp_path / "a.sog")
    step = 0.501 * 8 / 255
    assert np.abs(back.opacity_logits - truth.opacity_logits).max() <= step
    assert np.abs(back.log_scales - np.clip(truth.log_scales, -4, 4)).max() <= step


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("meta.json", b"{", "no SOG scene, or damaged"),
        ("meta.json", b"[]", "no SOG scene, or damaged"),
        ("meta.json", b'{"version": 3}', "version 3, this program reads 1 and 2"),
        ("scales.webp", b"", "no 8-bit colour picture"),
        ("scales.webp", b"RIFF", "no 8-bit colour picture"),
        ("scales.webp", webp(np.zeros((8, 3))), "8 texels for 20 Gaussians"),
        ("quats.webp", webp(np.full((20, 4), 128)), "saved lossily"),
        ("shN_labels.webp", webp(np.full((20, 2), 9)), "palette entry 2313 of 64"),
        ("shN_centroids.webp", webp(np.zeros((20, 3))), "too narrow for 3 coefficients"),
    ],
)
def test_damage_is_named(tmp_path, name, content, message):
    write_archive(tmp_path / "a.sog", {**sog(random_gaussians(20, 1)), name: content})
    with pytest.raises(ValueError, match=message):
        read_sog(tmp_path / "a.sog")


def test_missing_pictures_and_other_folders_are_refused(tmp_path):
    files = sog(random_gaussians(5, 0))
    write_archive(tmp_path / "a.sog", {name: files[name] for name in files if name != "quats.webp"})
    with pytest.raises(ValueError, match=r"quats\.webp"):
        read_sog(tmp_path / "a.sog")
    write_folder(tmp_path / "a", {name: files[name] for name in files if name != "quats.webp"})
    with pytest.raises(FileNotFoundError, match=r"quats\.webp"):
        read_sog(tmp_path / "a")
    write_folder(tmp_path / "a", {"meta.json": files["meta.json"].replace(b"quats.webp", b"../q.webp")})
    with pytest.raises(ValueError, match="outside its folder"):
        read_sog(tmp_path / "a")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_an_archive_cut_or_changed_anywhere_is_read_or_refused_in_one_sentence(tmp_path, data):
    write_archive(tmp_path / "a.sog", sog(random_gaussians(9, 1)))
    whole = bytearray((tmp_path / "a.sog").read_bytes())
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    (tmp_path / "b.sog").write_bytes(whole[: data.draw(st.integers(len(whole) // 2, len(whole)))])
    problem = "b.sog"
    try:
        read_sog(tmp_path / "b.sog")
    except ValueError as error:
        problem = str(error)
    assert "b.sog" in problem
