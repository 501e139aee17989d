"""What making pictures ready costs, on two tiny videos."""

from __future__ import annotations

import json

import av
import numpy as np
import pytest

from bench.reading import CAMERAS, main


def test_stages_add_up_to_what_a_rig_takes(tmp_path, capsys):
    folder = tmp_path / "videos"
    folder.mkdir()
    for name in ("a", "b"):
        with av.open(str(folder / f"{name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
            for grey in range(4):
                picture = np.full((64, 96, 3), 40 * grey, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    main([str(folder), "--out", str(tmp_path / "reading.json"), "--frames", "4"])
    found = json.loads((tmp_path / "reading.json").read_text())
    assert json.loads(capsys.readouterr().out) == found
    assert (found["size"], found["pictures"]) == ("96x64", 6)
    assert set(found["ms"]) == {"decode", "convert", "undistort", "mask", "copy"}
    assert min(*found["ms"].values(), found["ms_of_the_fit_itself"]) > 0
    seconds = found["cpu_seconds_an_instant"]
    assert seconds["as filmed"] == pytest.approx(CAMERAS * sum(found["ms"].values()) / 1000)
    assert seconds["as filmed"] - seconds["undistorted before"] == pytest.approx(
        CAMERAS * found["ms"]["undistort"] / 1000
    )
