"""Tests that the viewer answers its own page alone, and outlives whatever somebody sends."""

# ruff: noqa: E402 (viser may be missing)

import contextlib
import copy
import http.client
import itertools
import math
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.viewer import PATIENCE_S, Window, camera_message, open_window, pose_of, require_viewer, viewer

import hyaline
from model.view.schedule import Pose, camera_in_window

require_viewer()

import viser
from viser._messages import Message
from websockets.exceptions import ConnectionClosed, InvalidStatus

from model.view.server import Visitors, serving
from model.view.view import Viewer

pytestmark = pytest.mark.usefixtures("at_home")
packed = msgspec.msgpack.encode

HANDSHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}


def answer_to(port: int, headers: dict[str, str]) -> int:
    """The status of the answer to a request with these headers alone."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    with contextlib.closing(connection):
        connection.putrequest("GET", "/", skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status


@pytest.fixture
def served(home: Path) -> Iterator[tuple[str, Viewer]]:
    """The address of a viewer of a dataset, and the viewer."""
    with serving("127.0.0.1", 0, "one") as server:
        yield f"http://127.0.0.1:{server.get_port()}", Viewer(server, hyaline.open_dataset(home / "data" / "one"), None)


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("127.0.0.1:{port}", None, 101),
        ("127.0.0.1:{port}", "http://127.0.0.1:{port}", 101),
        ("LocalHost:9000", "http://localhost:9000", 101),  # Through `ssh -L 9000:localhost:8080`.
        ("[::1]:{port}", "http://[::1]:{port}", 101),
        ("127.0.0.1:{port}", "http://evil.example", 403),
        ("127.0.0.1:{port}", "http://127.0.0.1:1", 403),
        ("127.0.0.1:{port}", "http://localhost:{port}", 403),
        ("127.0.0.1:{port}", "null", 403),
        ("evil.example:{port}", "http://evil.example:{port}", 403),  # Whose name now leads to 127.0.0.1.
        ("127.0.0.1.evil.example", None, 403),
        ("192.0.2.1:{port}", None, 403),
        ("evil.example@127.0.0.1[", None, 403),
        ("", None, 403),
        (None, None, 403),
    ],
)
def test_only_the_viewers_own_page_under_a_name_of_this_machine_is_let_in(
    served: tuple[str, Viewer], host: str | None, origin: str | None, status: int
) -> None:
    port = int(served[0].rpartition(":")[2])
    own = {"Host": host, "Origin": origin}
    headers = {name: value.format(port=port) for name, value in own.items() if value is not None}
    assert answer_to(port, headers | HANDSHAKE) == status
    assert answer_to(port, headers) == (200 if status == 101 else status), "the page itself, too"


def test_with_another_host_its_own_addresses_and_names_are_let_in() -> None:
    visitors = Visitors("0.0.0.0", protocol="viser-v1", takes=lambda *_: False)
    for host in ("192.0.2.1:8080", f"{socket.gethostname()}:80", f"{socket.gethostname()}.local", "localhost"):
        assert visitors.knows(host), host
    assert not visitors.knows("evil.example")
    named = Visitors("Workstation.example.org", protocol="viser-v1", takes=lambda *_: False)
    assert named.knows("workstation.example.org:8080") and not named.knows("192.0.2.1")


def hostile_messages(pose: Pose, controls: dict[str, str], names: list[str]) -> Iterator[bytes | str]:
    """What no page of viser's would send: first what was once deadly, then hundreds of messages with a flaw each."""
    camera = camera_message(pose)
    slider = controls["layer"]
    yield from (packed(camera | {"wxyz": [0.0] * 4}), packed(camera | {"position": [0.0, 0.0]}))
    yield packed({"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 10**9}})
    yield packed({"type": "GuiUpdateMessage", "uuid": slider, "updates": {"update_cb": "text"}})
    for choice in ["truth", "none"] * 50:  # Each is carried out in a thread of its own.
        yield packed({"type": "GuiUpdateMessage", "uuid": controls["meshes"], "updates": {"value": choice}})
    yield packed({"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 0}}).replace(b"uuid", b"uu\xedd")
    yield from (b"", b"\xc1", b"\x91" * 50_000, b"\x81\xa4type" * 5000, "text", packed({"type": "ShareUrlRequest"}))
    click = {"type": "SceneNodeClickMessage", "name": names[0], "instance_index": None, "ray_origin": [0.0] * 3}
    click |= {"ray_direction": [0.0, 0.0, 1.0], "screen_pos": [0.5, 0.5], "modifier": None, "owner": ""}
    sound = [camera, click]
    sound += [{"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": 0}} for uuid in controls.values()]
    rng = np.random.default_rng(7)
    kinds = [kind.__name__ for kind in Message.get_subclasses()]
    for _ in range(500):
        message = copy.deepcopy(sound[rng.integers(len(sound))])
        holder = message.get("updates", message) if rng.random() < 0.7 else message
        field = str(rng.choice(list(holder)))
        flaw = rng.random()
        if flaw < 0.1:
            message["type"] = str(rng.choice(kinds))
        elif flaw < 0.2:
            del holder[field]
        elif flaw < 0.3:
            holder[str(rng.choice(["value", "visible", "update_cb", "options", "max", "x"]))] = strange(rng)
        elif flaw < 0.5 and isinstance(holder[field], list):
            holder[field][rng.integers(len(holder[field]))] = strange(rng)
        else:
            holder[field] = strange(rng)
        data = bytearray(packed(message))
        if rng.random() < 0.2:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        yield bytes(data[: rng.integers(len(data))] if rng.random() < 0.05 else data)


def test_no_message_ends_the_connection_that_it_comes_by() -> None:
    require_viewer()
    pose = pose_of(hyaline.open_dataset("one"), (48, 32))
    visitors = Visitors("127.0.0.1", protocol="viser-v1", takes=lambda *_: True)
    controls = {name: f"{place}-uuid" for place, name in enumerate(("layer", "pause", "meshes"))}
    passed_on = [visitors.check(data) for data in hostile_messages(pose, controls, ["/cameras/0"])]
    assert None in passed_on and any(passed_on)


def strange(rng: np.random.Generator) -> object:
    values = [math.nan, math.inf, -math.inf, 1e308, -1e30, 1e-300, 0, -1, 10**9, 2**63 - 1, True, None, "", "text"]
    values += ["x" * 60_000, [], {}, [0.0] * 2, [0.0] * 3, [0.0] * 4, [math.nan] * 3, [1e38] * 3, [[]], {"value": 1}]
    return values[rng.integers(len(values))]


def panel_of(window: Window) -> tuple[dict[str, str], list[str]]:
    """The UUIDs of the controls by their labels, and the names of the cameras."""
    controls: dict[str, str] = {}
    names = []
    for message, _ in window.messages(PATIENCE_S):
        if message["type"] == "ReplayDoneMessage":
            break
        if message["type"] in ("GuiSliderMessage", "GuiDropdownMessage", "GuiCheckboxMessage"):
            controls[message["props"]["label"]] = message["uuid"]
        if message["type"] == "CameraFrustumMessage":
            names.append(message["name"])
    return controls, names


def test_whatever_a_visitor_sends_the_viewer_goes_on_for_the_others() -> None:
    require_viewer()
    run = hyaline.open_run("one/paper", device="cpu")
    pose = pose_of(run.dataset, (48, 32))
    torch.set_num_threads(1)
    truth = run.render(camera_in_window(pose.position, pose.wxyz, pose.fov_y, 48, 32))
    with viewer("one/paper") as (process, address):
        with open_window(address) as other, open_window(address) as hostile:
            controls, names = panel_of(other)
            assert {"layer", "pause", "meshes", "the camera sees"} < set(controls)
            hostile.stand_at(pose)
            for data in hostile_messages(pose, controls, names):
                hostile.send_bytes(data)
            with pytest.raises(ConnectionClosed):
                hostile.send_bytes(b"x" * (1 << 20))
                list(hostile.messages(PATIENCE_S))
            other.stand_at(pose)
            picture = next(picture for kind, picture in other.pictures(PATIENCE_S) if kind == "png")
            assert np.array_equal(picture, truth)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (130, "")
    assert err == "one/paper: open the address in a browser; Ctrl-C stops the viewer\n"


def test_a_control_takes_the_values_that_it_offers_and_no_others(served: tuple[str, Viewer]) -> None:
    address, shown = served
    with open_window(address) as one, open_window(address) as other:
        panel_of(other)
        controls, _ = panel_of(one)
        one.stand_at(pose_of(hyaline.open_dataset("one"), (48, 32)))
        wrong = {"layer": [-1, 10**9, 1.5, True, "1", math.nan], "pause": [0, "", None]}
        wrong |= {"the camera sees": ["elsewhere", "", 0, True], "meshes": ["elsewhere"]}
        right = {"layer": 2, "pause": True, "the camera sees": "layer"}
        for label, value in [(label, value) for label, values in wrong.items() for value in values] + [*right.items()]:
            one.send({"type": "GuiUpdateMessage", "uuid": controls[label], "updates": {"value": value}})
        heard = []
        for message, _ in other.messages(PATIENCE_S):
            if message["type"] == "GuiUpdateMessage" and "value" in message["updates"]:
                heard.append((message["uuid"], message["updates"]["value"]))
            if len(heard) == 3:
                break
    assert heard == [(controls[label], value) for label, value in right.items()]
    assert (shown.panel.sight, shown.panel.layer, shown.panel.is_paused) == ("layer", 2, True)


def test_a_browser_begins_where_the_scene_is_to_be_seen_however_many_cameras_there_are(tmp_path: Path) -> None:
    require_viewer()
    dataset = write_synthetic_dataset(tmp_path / "data" / "many", train_views=40)
    with serving("127.0.0.1", 0, "many") as server:
        address = f"http://127.0.0.1:{server.get_port()}"
        with pytest.raises(InvalidStatus) as too_early, open_window(address):
            pass
        assert too_early.value.response.status_code == 503, "asks again, instead of beginning with half of the scene"
        Viewer(server, dataset, None)
        with open_window(address) as window:
            windows = [messages for messages, _ in itertools.islice(window.windows(PATIENCE_S), 2)]
            window.stand_at(pose_of(dataset, (48, 32)))  # Where an earlier viewer's page has been left.
            moved = {"SetCameraPositionMessage": "position", "SetCameraLookAtMessage": "look_at"}
            there = {}
            for message, _ in window.messages(PATIENCE_S):
                if message["type"] in moved and not message["initial"]:
                    there[message["type"]] = message[moved[message["type"]]]
                if len(there) == 2:
                    break
    assert len(windows[0]) == 128, "viser sends the rest apart"
    begin = {message["type"]: message for message in windows[0] if message.get("initial")}
    assert set(begin) == {f"SetCamera{what}Message" for what in ("Position", "LookAt", "UpDirection", "Fov")}
    for kind, key in moved.items():
        assert np.allclose(there[kind], begin[kind][key])
