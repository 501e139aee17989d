"""Import a splat file as a scene of one frame, and export that frame again, as another program wants it.

    python examples/convert_splat.py IN.ply OUT.spz

Several files make a sequence. The report tells what the way through a scene file costs, in Gaussians and in decibels.
"""

import sys
import tempfile
from pathlib import Path

import packuv
from packuv.interchange import SplatFormat, format_of, write_gaussians
from packuv.interchange.adopt import AdoptOptions, adopt, find_frames


def main(source: Path, out: Path) -> None:
    kind = format_of(out) or SplatFormat.PLY
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.mkv"
        report = adopt(find_frames([source]), path, options=AdoptOptions(uv=None))  # no UV map: keep all that is drawn
        print(
            f"{report.gaussians:,} Gaussians, {report.kept_share:.1%} of what is drawn is kept, {report.bytes:,} bytes"
        )
        print(f"pictures of the scene agree with the splat's to {min(report.psnr_db):.1f} dB at worst")
        with packuv.open_scene(path) as scene:
            count = write_gaussians(out, scene.gaussians(0), kind=kind)
    print(f"{count:,} Gaussians in {out}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
