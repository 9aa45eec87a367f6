"""Tests which picture is drawn next: coarse while a camera moves, finer when it stands, never for who has gone."""

import numpy as np
import pytest

from datagen.data.cameras import Camera, look_at
from hyaline_web.view.live_run import STILL_S, Job, Pose, Schedule, camera_in_window, window_pose


def pose(window: tuple[int, int] = (640, 480), *, x: float = 1.0) -> Pose:
    camera = Camera(world_from_camera=look_at((x, 1.5, 1.2), (0.0, 0.0, 0.2)), fov_x=0.9, width=4, height=3)
    position, wxyz, fov_y = window_pose(camera)
    return Pose(position=position, wxyz=wxyz, fov_y=fov_y, window=window)


def jobs_until_done(schedule: Schedule, now: float) -> list[Job]:
    found = []
    while (job := schedule.next_job(now)) is not None:
        assert schedule.is_wanted(job)
        found.append(job)
        schedule.finish(job)
    return found


def test_a_camera_is_the_same_there_and_back() -> None:
    camera = Camera(world_from_camera=look_at((1.0, 1.5, 1.2), (0.0, 0.0, 0.2)), fov_x=0.9, width=64, height=40)
    position, wxyz, fov_y = window_pose(camera)
    again = camera_in_window(position, wxyz, fov_y, 64, 40)
    assert np.allclose(again.world_from_camera, camera.world_from_camera)
    assert again.fov_x == pytest.approx(0.9)
    assert np.linalg.norm(wxyz) == pytest.approx(1)
    # OpenCV's camera looks along +z, and its +y points down: at a point below the horizon, world z falls along both.
    assert camera.world_from_camera[2, 2] > 0 > -camera.world_from_camera[2, 1]


def test_a_moving_camera_gets_one_quick_picture_a_pose_and_a_still_one_finer_and_finer_ones() -> None:
    schedule = Schedule()
    for move in range(4):
        schedule.move(1, pose(x=1 + 0.1 * move), now=0.1 * move)
        job = schedule.next_job(0.1 * move)
        assert job is not None and job.is_quick
        assert (job.camera.width, job.camera.height) == (64, 48)
        schedule.finish(job)
        assert schedule.next_job(0.1 * move + 0.01) is None, "the camera has only just moved"
    still = jobs_until_done(schedule, 0.3 + STILL_S)
    assert not any(job.is_quick for job in still)
    sizes = [(job.camera.width, job.camera.height) for job in still]
    assert sizes == [(64, 48), (128, 96), (256, 192), (512, 384)], "as the window, 640 x 480, and no larger"


def test_a_picture_is_no_longer_wanted_when_the_camera_moves_on_what_is_seen_changes_or_the_browser_goes() -> None:
    schedule = Schedule()
    for end in (lambda: schedule.move(1, pose(x=2), 5.0), schedule.redraw, lambda: schedule.forget(1)):
        schedule.move(1, pose(), now=0.0)
        job = schedule.next_job(0.0)
        assert job is not None and schedule.is_wanted(job)
        end()
        assert not schedule.is_wanted(job)
        # What came too late does not count as drawn.
        schedule.finish(job)
        following = schedule.next_job(100.0)
        assert following is None if not schedule.is_watched else following is not None and following.is_quick
    assert not schedule.is_watched
