"""A browser as far as `model view` can tell: it says where its camera is, and gets pictures."""

import importlib.util
import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.data.dataset import Dataset
from hyaline_web.view.live_run import Pose, window_pose

PATIENCE_S = 180


def require_viewer() -> None:
    """Skips the test where viser is not installed; fails it where tests in a browser are demanded, as CI does."""
    if importlib.util.find_spec("viser") is None:
        missing = 'viser: not installed; `pip install -c constraints.txt -e ".[view]"` brings it'
        if os.environ.get("HYALINE_DEMAND_BROWSER"):
            pytest.fail(missing)
        pytest.skip(missing, allow_module_level=True)


@contextmanager
def viewer(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A viewer of its own, and its address."""

    def take_signals() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell's job in the background ignores it.

    process = subprocess.Popen(
        [sys.executable, "-m", "model", "view", *words, "--port", "0", "--device", "cpu"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=take_signals,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with process:  # Which closes its pipes, and waits for it.
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def pose_of(dataset: Dataset, window: tuple[int, int]) -> Pose:
    position, wxyz, fov_y = window_pose(dataset.view("interpolating", 0).camera)
    return Pose(position=position, wxyz=wxyz, fov_y=fov_y, window=window)


class Window:
    """One connection to a viewer, in the messages of viser's own page."""

    patience_s: float = PATIENCE_S
    """How long a silence may last."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self.heard: list[str] = []
        """The kinds of messages so far."""

    def stand_at(self, pose: Pose) -> None:
        """Says, as viser's page does, that the camera is here now."""
        import msgspec

        message = {
            "type": "ViewerCameraMessage",
            "wxyz": pose.wxyz.tolist(),
            "position": pose.position.tolist(),
            "fov": pose.fov_y,
            **{"near": 0.01, "far": 1000.0, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0]},
            **dict(zip(("image_width", "image_height"), pose.window, strict=True)),
        }
        self._connection.send(msgspec.msgpack.encode(message))

    def messages(self) -> Iterator[tuple[dict[str, Any], list[bytes]]]:
        """What the viewer says until it is silent, each message with the binary parts of all that came with it."""
        import msgspec
        import zstandard

        while True:
            try:
                data = self._connection.recv(timeout=self.patience_s)
            except TimeoutError:
                return
            size, packed = (int.from_bytes(data[place : place + 8], "little") for place in (0, 8))
            unpacked = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], max_output_size=size)
            content = msgspec.msgpack.decode(unpacked)
            place, parts = 16 + packed, []
            for length in content["binaryBufferLengths"]:
                place += -place % 8
                parts.append(data[place : place + length])
                place += length
            for message in content["messages"]:
                self.heard.append(message["type"])
                yield message, parts

    def pictures(self) -> Iterator[np.ndarray]:
        """The pictures behind the scene, as they arrive."""
        for message, parts in self.messages():
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                data = message["rgb_data"]
                data = parts[data["__binary_index"]] if isinstance(data, dict) else data
                yield np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


@contextmanager
def open_window(address: str) -> Iterator[Window]:
    """Connects to a viewer at http://HOST:PORT."""
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    place = address.replace("http://", "ws://")
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    with connect(place, subprotocols=spoken, max_size=None, compression=None) as connection:
        yield Window(connection)
