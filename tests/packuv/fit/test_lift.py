import numpy as np

from packuv.fit.lift import LiftOptions, lift_motion


def flows_of(cameras, points, step):
    """Exact flow of points that all move by `step`, painted where each point is, and masks of these pixels."""
    flows, masks = [], []
    for camera in cameras:
        before, after = camera.project(points)[0], camera.project(points + step)[0]
        flow, mask = (
            np.zeros((camera.height, camera.width, 2), np.float32),
            np.zeros((camera.height, camera.width), bool),
        )
        for (x, y), moved in zip(before.astype(int), after - before, strict=True):
            if 0 <= x < camera.width and 0 <= y < camera.height:
                flow[y, x], mask[y, x] = moved, True
        flows.append(flow)
        masks.append(mask)
    return flows, masks


def test_the_step_of_points_comes_back_from_their_flow(ring):
    cameras = ring(6, width=320, height=240)
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (12, 3))
    step = np.array([0.05, -0.03, 0.04])
    flows, masks = flows_of(cameras, points, step)
    found = lift_motion(points, cameras, flows, masks, near=0.1, options=LiftOptions(ridge=1e-4))
    # First order in the step: 0.07 against a distance of 4.
    assert np.abs(found - step).max() < 0.04 * np.linalg.norm(step)


def test_one_camera_that_sees_something_else_has_no_say(ring):
    cameras = ring(8, width=320, height=240)
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (12, 3))
    step = np.array([0.04, 0.0, 0.03])
    flows, masks = flows_of(cameras, points, step)
    flows[3][:], masks[3][:] = 40.0, True
    found = lift_motion(points, cameras, flows, masks, near=0.1, options=LiftOptions(ridge=1e-4, rounds=8))
    assert np.abs(found - step).max() < 0.1 * np.linalg.norm(step)


def test_points_without_flow_or_seen_by_one_camera_stay(ring):
    cameras = ring(4)
    points = np.zeros((3, 3))
    still = [np.zeros((64, 96, 2), np.float32)] * 4
    masks = [np.zeros((64, 96), bool)] * 4
    assert not lift_motion(points, cameras, still, masks, near=0.1, options=LiftOptions()).any()
    moving = [np.full((64, 96, 2), 3, np.float32), None, None, None]
    assert not lift_motion(points, cameras, moving, [None] * 4, near=0.1, options=LiftOptions()).any()
    assert not lift_motion(points, cameras, [None] * 4, masks, near=0.1, options=LiftOptions()).any()
