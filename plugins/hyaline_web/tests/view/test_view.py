"""Tests `model view` from outside: a run and a dataset in a browser, the end by Ctrl-C, and what is refused."""

import signal
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.browser import check_accessible, require_browser
from support.commands import call
from support.viewer import PATIENCE_S, open_window, pose_of, require_viewer, viewer

import hyaline
from benchmarks.browser import running_browser, watched_page
from datagen.terminal.command import Held
from hyaline_web.view.live_run import camera_in_window

pytestmark = pytest.mark.usefixtures("at_home")


def test_a_browser_gets_what_the_run_predicts_from_its_own_camera_and_ctrl_c_ends_the_viewer_quietly() -> None:
    require_viewer()
    run = hyaline.open_run("one/paper", device="cpu")
    pose = pose_of(run.dataset, (64, 48))
    torch.set_num_threads(1)
    truth = run.render(camera_in_window(pose.position, pose.wxyz, pose.fov_y, 64, 48))
    with viewer("one/paper") as (process, address):
        assert address.startswith("http://127.0.0.1:")
        with open_window(address) as window:
            window.stand_at(pose)
            # A quick picture may come before, unless this one has overtaken it on the way.
            assert any(np.array_equal(picture, truth) for picture in window.pictures())
            notes = [kind for kind in window.heard if "Notification" in kind]
            assert notes == ["NotificationShowMessage", "RemoveNotificationMessage"]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert out == ""
    assert err == "one/paper: open the address in a browser; Ctrl-C stops the viewer\n"


def test_a_dataset_without_runs_shows_its_cameras_with_their_pictures_and_its_meshes(home: Path) -> None:
    require_viewer()
    from hyaline_web.view.view import Viewer, serving

    dataset = hyaline.open_dataset("one")
    views = [(split, view) for split, count in dataset.num_views.items() for view in range(count)]
    names: set[str] = set()
    pictures = 0
    with serving(0, "one") as server:
        shown = Viewer(server, dataset, None)
        with open_window(f"http://127.0.0.1:{server.get_port()}") as window:
            window.stand_at(pose_of(dataset, (48, 32)))
            window.patience_s = 0.1
            for _ in range(100):
                shown.step(Held())
                for message, _ in window.messages():
                    if message["type"] in ("CameraFrustumMessage", "MeshMessage"):
                        names.add(message["name"])
                    pictures += "_image_data" in message.get("updates", {})
                if pictures == len(views):
                    break
            view = shown.stage.asked = dataset.view("interpolating", 0)
            shown.step(Held())
            assert shown.stage.asked is None
            shown.stage.show(view, view.image ^ 1)
            labels = [text["props"]["label"] for text, _ in window.messages() if text["type"] == "GuiImageMessage"]
    assert labels[-1] == "interpolating 0: truth, prediction (48.13 dB), error × 8"  # noqa: RUF001
    assert pictures == len(views) == 6
    assert names == {f"/cameras/{split}/{view:04d}" for split, view in views} | {"/meshes/pane", "/meshes/floor"}


def test_the_viewers_own_controls_are_accessible() -> None:
    require_viewer()
    require_browser()
    with viewer("one") as (_, address), running_browser() as browser, watched_page(browser, width=800) as watched:
        watched.page.goto(address)
        watched.page.get_by_text("Click a camera").wait_for()
        check_accessible(watched, besides=("button-name", "region"))  # viser 1.1's own.


@pytest.mark.parametrize(
    ("line", "status", "error"),
    [
        ("model view nothing", 1, "error: nothing: neither a run nor a dataset; expected a folder such as runs"),
        ("model view one --port 70000", 2, "error: --port: is 70000; expected 0 to 65535"),
        ("model view one --port {taken}", 1, "error: --port: {taken} is taken, perhaps by another viewer"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(line: str, status: int, error: str) -> None:
    require_viewer()
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        answer = call(line.format(taken=taken))
    assert (answer.status, answer.out) == (status, "")
    assert answer.err.startswith(error.format(taken=taken)) and answer.err.count("\n") == 1


def test_without_viser_the_way_to_install_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in [name for name in sys.modules if name.startswith("hyaline_web.view.")]:
        monkeypatch.delitem(sys.modules, name)
    answer = call("model view one")
    assert answer.status == 1
    assert answer.err == (
        'error: model view: needs viser, which is not installed; `pip install "hyaline-glass[view]"` brings it\n'
    )
