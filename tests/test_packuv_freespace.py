import numpy as np
import pytest

from packuv.freespace import FreeSpaceOptions, sweep_free_space
from packuv.start import Bounds, StartOptions, find_bounds, first_gaussians

BOUNDS = Bounds(np.zeros(3), 2.0, 0.2)
OPTIONS = FreeSpaceOptions(cells=64, votes=2)


def fan(end, count=4):
    """Lines of sight from several cameras to one place."""
    angles = np.linspace(0, 1.0, count)
    origins = 2 * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    return origins, np.repeat(np.asarray(end, float)[None], count, axis=0)


def test_the_air_before_a_point_is_empty_and_the_point_itself_is_not():
    origins, ends = fan([-1.0, 0.0, 0.0])
    air = sweep_free_space(np.repeat(origins, 2, 0), np.repeat(ends, 2, 0), bounds=BOUNDS, options=OPTIONS)
    halfway = (origins + ends) / 2
    assert air.contains(halfway).all()
    assert not air.contains(ends).any()
    behind = ends + 0.3 * (ends - origins) / np.linalg.norm(ends - origins, axis=1, keepdims=True)
    assert not air.contains(behind).any()


def test_one_line_alone_decides_nothing():
    origins, ends = fan([-1.0, 0.0, 0.0], count=1)
    air = sweep_free_space(origins, ends, bounds=BOUNDS, options=OPTIONS)
    assert not air.contains((origins + ends) / 2).any()
    assert air.share == 0


def test_outside_the_cube_nothing_is_known():
    origins, ends = fan([-1.0, 0.0, 0.0])
    air = sweep_free_space(origins, ends, bounds=BOUNDS, options=OPTIONS)
    assert not air.contains(np.array([[100.0, 0, 0], [0, -100.0, 0], [np.inf, 0, 0]])).any()


def test_no_lines_leave_everything_open():
    air = sweep_free_space(np.empty((0, 3)), np.empty((0, 3)), bounds=BOUNDS, options=OPTIONS)
    assert air.share == 0


def test_every_crossed_cell_equals_a_fine_walk():
    rng = np.random.default_rng(0)
    origins, ends = rng.uniform(-2, 2, (30, 3)), rng.uniform(-2, 2, (30, 3))
    options = FreeSpaceOptions(cells=32, votes=1, margin_cells=0.0)
    air = sweep_free_space(origins, ends, bounds=BOUNDS, options=options)
    walk = origins[:, None] + (ends - origins)[:, None] * np.linspace(0, 0.999, 400)[None, :, None]
    # Half-cell steps cut corners of cells: nearly every place on a line lies in a counted cell.
    assert air.contains(walk.reshape(-1, 3)).mean() > 0.9


def test_no_gaussian_starts_in_empty_air(ring):
    cameras = ring(6)
    pictures = [np.full((3, c.height, c.width), 0.5, np.float32) for c in cameras]
    bounds = find_bounds(cameras, near_share=0.1)

    def right_half(points: np.ndarray) -> np.ndarray:
        return points[:, 0] > 0

    start = first_gaussians(cameras, pictures, bounds=bounds, points=None, empty=right_half,
                            options=StartOptions(count=100), sh_degree=0, seed=0)  # fmt: skip
    assert len(start) == 100
    assert (start.means[:, 0] <= 0).all()


@pytest.mark.parametrize("cells", [1, 8])
def test_small_grids_work(cells):
    origins, ends = fan([-1.0, 0.5, 0.0])
    options = FreeSpaceOptions(cells=cells, votes=1)
    sweep_free_space(origins, ends, bounds=BOUNDS, options=options).contains(ends)
