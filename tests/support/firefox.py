"""A Firefox on a screen that nobody sees, which opens pages from disk, driven through Marionette, its own protocol.

Without a screen (`--headless`) Firefox finds no driver for WebGL on a machine without a GPU; on Xvfb's it draws with
Mesa's, on the processor.
"""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from datagen.disk.errors import HyalineError

PROGRAMS = ("firefox-esr", "firefox")

PREFERENCES: dict[str, object] = {
    "marionette.port": 0,  # Any that is free; a file in the profile says which.
    "webgl.force-enabled": True,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.enabled": False,
}

PATIENCE_S = 120


def find_firefox() -> tuple[str, str]:
    """The system's Firefox and Xvfb.

    Raises:
        HyalineError: one is missing.
    """
    firefox = next(filter(None, map(shutil.which, PROGRAMS)), None)
    screen = shutil.which("Xvfb")
    if firefox is None or screen is None:
        raise HyalineError(
            f"browser: {'none of ' + ', '.join(PROGRAMS) if firefox is None else 'no Xvfb'} is there; install the "
            "system's packages firefox-esr and xvfb, such as by `apt-get install firefox-esr xvfb`"
        )
    return firefox, screen


class Firefox:
    """A window of a running Firefox."""

    def __init__(self, connection: socket.socket) -> None:
        self._stream = connection.makefile("rwb")
        self._sent = 0
        self._receive()  # Its greeting.
        self._command("WebDriver:NewSession", {"capabilities": {}})
        self._command("WebDriver:SetTimeouts", {"script": PATIENCE_S * 1000})

    def open_file(self, path: Path) -> None:
        """Opens a page from disk, and waits until its scene is there."""
        self._command("WebDriver:Navigate", {"url": path.resolve().as_uri()})
        self._evaluate("() => null")

    def picture(self, view: str, shape: tuple[int, int], samples: int) -> np.ndarray:
        """The page's picture of a view of the dataset, of so many rays a pixel: (h, w, 3)."""
        height, width = shape
        encoded = self._evaluate("(page, given) => page.picture(...given)", [view, width, height, samples])
        return np.array(encoded, np.uint8).reshape(height, width, 4)[..., :3]

    def _evaluate(self, function: str, given: object = None) -> Any:
        """What a function of the page answers, awaited."""
        script = f"""
            const done = arguments[arguments.length - 1];
            window.hyaline.then((page) => ({function})(page, arguments[0])).then(
                (value) => done([value === undefined ? null : JSON.stringify(value), null]),
                (error) => done([null, String(error)]));
        """
        value, error = self._command("WebDriver:ExecuteAsyncScript", {"script": script, "args": [given]})["value"]
        if error is not None:
            raise HyalineError(f"firefox: {error}")
        return json.loads(value)

    def _command(self, name: str, parameters: dict[str, object]) -> Any:
        self._sent += 1
        text = json.dumps([0, self._sent, name, parameters]).encode()
        self._stream.write(b"%d:%s" % (len(text), text))
        self._stream.flush()
        _, _, error, result = self._receive()
        if error is not None:
            raise HyalineError(f"firefox: {name}: {error['message']}")
        return result

    def _receive(self) -> Any:
        size = b""
        while (byte := self._stream.read(1)) != b":":
            if not byte:
                raise HyalineError("firefox: ended before it answered")
            size += byte
        return json.loads(self._stream.read(int(size)))


@contextlib.contextmanager
def running_firefox() -> Iterator[Firefox]:
    """A Firefox with a profile of its own, whose drawing is computed by the processor."""
    program, screen = find_firefox()
    with tempfile.TemporaryDirectory() as folder, _running_screen(screen) as display:
        profile = Path(folder)
        lines = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in PREFERENCES.items())
        (profile / "user.js").write_text("".join(lines))
        arguments = ["--no-remote", "--marionette", "--profile", folder]
        surroundings = {**os.environ, "DISPLAY": display, "LIBGL_ALWAYS_SOFTWARE": "1", "HOME": folder}
        with (
            _running([program, *arguments], env=surroundings),
            socket.create_connection(("127.0.0.1", _port(profile)), timeout=PATIENCE_S) as connection,
        ):
            yield Firefox(connection)


@contextlib.contextmanager
def _running_screen(program: str) -> Iterator[str]:
    """The name of a display of its own."""
    reader, writer = os.pipe()
    try:
        arguments = ["-displayfd", str(writer), "-screen", "0", "1024x768x24", "-nolisten", "tcp"]
        with _running([program, *arguments], pass_fds=(writer,)), open(reader, closefd=False) as answer:
            os.close(writer)
            yield f":{answer.readline().strip()}"
    finally:
        os.close(reader)


@contextlib.contextmanager
def _running(command: list[str], **settings: Any) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **settings)
    try:
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def _port(profile: Path) -> int:
    """Where the Firefox of a profile listens."""
    ends = time.monotonic() + PATIENCE_S
    while time.monotonic() < ends:
        with contextlib.suppress(FileNotFoundError, ValueError):
            return int((profile / "MarionetteActivePort").read_text())
        time.sleep(0.1)
    raise HyalineError(f"firefox: does not listen after {PATIENCE_S} seconds")
