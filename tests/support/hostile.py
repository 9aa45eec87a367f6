"""Hostile files, the world of good ones that each of them is put into, and the readers of both."""

import copy
import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.builder.verify import verify_dataset
from datagen.data.cameras import look_at
from datagen.data.dataset import open_dataset
from datagen.data.geometries import ProxyStatistics, read_meshes, write_proxies
from datagen.data.images import decode_exr, png_bytes
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import SEAL, seal_bytes
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Truth, truth_files
from datagen.scene.folder import load_scene, save_scene
from eval.score.runs import open_run, read_prediction
from hyaline_import.commands import DatasetImportChoices
from hyaline_import.datasets.import_dataset import plan_import
from model.methods.paper.config import PaperConfig
from model.run.predict import load_renderer, render_predictions
from model.run.run_folder import TrainConfig, read_predictions, read_run
from model.run.train import train
from model.state import CHECKPOINT_VERSION, fingerprint

DATASET, RUN, FOREIGN = "data/one", "runs/one/paper", "runs/one/foreign"
MARK = "MARK-OF-CODE-THAT-RAN"
"""A file that a hostile pickle makes in the working folder, when it is let."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One file or folder that is not what its reader hopes for."""

    name: str
    path: str
    """Relative to the world: a key of `READERS`."""
    content: bytes | Callable[[Path], object]
    """What lies there, or what puts it there."""
    is_bad: bool = False
    """It has to be refused; others may be accepted."""

    def place(self, world: Path) -> None:
        """Puts it where the world has nothing."""
        path = world / self.path
        path.write_bytes(self.content) if isinstance(self.content, bytes) else self.content(path)


# The world


def write_world(root: Path) -> None:
    """A scene, a dataset with layers and proxies, a trained run, a foreign method's pictures, an EXR: all good."""
    save_scene(synthetic_scene(), root / "scene")
    dataset = write_synthetic_dataset(root / DATASET, resolution=8, train_views=2)
    numbers = ProxyStatistics(volume_ratio=1.0, mean_distance=0.0, max_distance=0.0)
    write_proxies(dataset, "box", read_meshes(dataset, TRUTH), (numbers, numbers))
    net = PaperConfig(width=8, texture_size=8, position_size=8)
    config = TrainConfig(method="paper", geometry=TRUTH, net=net, steps=1, batch=16)
    run, cpu = root / RUN, torch.device("cpu")
    train(config, dataset, run, label="paper", device=cpu)
    render_predictions(run, config, dataset, device=cpu)
    shutil.copytree(run / "predictions", root / FOREIGN / "predictions")
    use_mitsuba()
    ramp = np.linspace(0, 1, 192, dtype=np.float32).reshape(8, 8, 3)
    truth = Truth(radiance=ramp, half_difference=0.01 * ramp, spp=4, noise_mse=1e-5)
    (root / "view.exr").write_bytes(truth_files(truth)[".exr"])
    (root / "theirs").mkdir()
    frames = []
    for view in range(4):
        (root / f"theirs/{view}.png").write_bytes(png_bytes(np.zeros((8, 12, 3), np.uint8)))
        frames.append({"file_path": f"{view}.png", "transform_matrix": look_at((2, view, 1), (0, 0, 0)).tolist()})
    lens = {"fl_x": 10.0, "fl_y": 10.0, "cx": 6.5, "cy": 4.0, "w": 12, "h": 8, "k1": 0.0}
    (root / "theirs/transforms.json").write_bytes(text_of({**lens, "frames": frames}))


def _verified(root: Path) -> None:
    dataset = open_dataset(root / DATASET)
    dataset.view("train", 0).layers()
    read_meshes(dataset, "box")
    if problems := verify_dataset(root / DATASET).problems:
        raise HyalineError(problems[0])


def _run(root: Path) -> None:
    config = read_run(root / RUN).config
    read_predictions(root / RUN)
    read_prediction(open_run(root / RUN, root / "data"), "interpolating", 0)
    load_renderer(root / RUN, config, open_dataset(root / DATASET))


READERS: dict[str, Callable[[Path], object]] = {
    **dict.fromkeys(("scene/scene.json", "scene/meshes/pane.ply"), lambda root: load_scene(root / "scene")),
    **{
        f"{DATASET}/{path}": _verified
        for path in (
            *("dataset.json", "transforms_train.json", "records/train/0000.json", "proxies/box/proxies.json"),
            *("layers/straight/layers.json", "layers/straight/records/train/0000.json"),
        )
    },
    **{f"{RUN}/{path}": _run for path in ("run.json", "predictions.json", "weights.pt")},
    f"{FOREIGN}/predictions/interpolating/0000.png": lambda root: read_prediction(
        open_run(root / FOREIGN, root / "data"), "interpolating", 0
    ),
    "view.exr": lambda root: decode_exr((root / "view.exr").read_bytes()),
    "theirs/transforms.json": lambda root: plan_import(root / "theirs", DatasetImportChoices()),
}
"""What reads each file, in a world."""


# Files


NOT_FILES: dict[str, Callable[[Path], object]] = {
    "nothing": lambda place: None,
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "link to itself": lambda place: place.symlink_to(place.name),
    "link to nothing": lambda place: place.symlink_to("nowhere"),
    "endless": lambda place: place.symlink_to("/dev/zero"),
    "empty": Path.touch,
    "binary": lambda place: place.write_bytes(bytes(range(256)) * 8),
}
"""Things that lie where a file belongs."""

RAW = {"NAN": "NaN", "INFINITY": "Infinity", "HUGE": "1" + "0" * 400, "DIGITS": "9" * 5000, "EXPONENT": "1e999"}
"""Numbers that no Python number would be written as."""
VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**63, 0.5, "", "\x00", "../../../etc/passwd", "/etc/passwd", "\x1b[31mred\x07"),
    *("x" * 100_000, "\ud800", [], {}, [[[]]], {"type": []}, {"type": "Nothing"}),
    *("@NAN", "@INFINITY", "@HUGE", "@DIGITS", "@EXPONENT"),
)


def text_of(value: Any) -> bytes:
    """JSON with raw numbers where strings say so."""
    text = json.dumps(value, indent=1)
    for name, raw in RAW.items():
        text = text.replace(f'"@{name}"', raw)
    return text.encode("utf-8", "surrogatepass")


def sealed(value: dict[str, Any]) -> bytes:
    """The same with the seal that a careful attacker would give it, where the file has one."""
    if SEAL not in value:
        return text_of(value)
    value = {key: item for key, item in value.items() if key != SEAL}
    try:
        return seal_bytes(json.loads(text_of(value)))
    except (ValueError, UnicodeError, HyalineError):
        # No such file can have a seal of ours.
        return text_of({**value, SEAL: "0" * 64})


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a JSON value below the whole; of long lists the first two items."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


def changed(value: Any, path: tuple[str | int, ...], *new: Any) -> Any:
    """A copy with another value at a place, or without that place."""
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    if new:
        (inner[path[-1]],) = new
    else:
        del inner[path[-1]]
    return value


def json_contents(good: bytes) -> Iterator[tuple[str, bytes]]:
    """A JSON file spoilt: two values at each place (another choice at each), keys lost and added."""
    value, turn = json.loads(good), 0
    for place in places(value):
        if place == (SEAL,):
            continue
        for new in (VALUES[turn % len(VALUES)], VALUES[(turn + 1) % len(VALUES)]):
            yield f"{place} = {json.dumps(new)[:30]}", sealed(changed(value, place, new))
        turn += 2
        if isinstance(place[-1], str):
            yield f"without {place}", sealed(changed(value, place))
    yield "another key", sealed({**value, "\x1b[2J": 1})


def text_contents(good: bytes) -> dict[str, bytes]:
    """Bytes that are not the JSON that they should be."""
    return {
        "cut in half": good[: len(good) // 2],
        "without its end": good[:-3],
        "twice": good + good,
        "null": b"null",
        "deep": b"[" * 100_000 + b"]" * 100_000,
        "UTF-16": good.decode().encode("utf-16"),
        "with a byte order mark": b"\xef\xbb\xbf" + good,
    }


def plies() -> dict[str, bytes]:
    """Meshes whose headers lie, whose numbers are none, and whose faces are of nothing."""
    head = "property float x\nproperty float y\nproperty float z\nproperty float s\nproperty float t\n"
    corners = ["-1 -1 0.5 0 0", "1 -1 0.5 1 0", "1 1 0.5 1 1", "-1 1 0.5 0 1"]

    def ply(vertices: object = 4, faces: object = 2, first: str = corners[0], face: str = "3 0 1 2") -> bytes:
        lists = f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
        lines = "\n".join([first, *corners[1:], face, "3 0 2 3", ""])
        return f"ply\nformat ascii 1.0\nelement vertex {vertices}\n{head}{lists}{lines}".encode()

    counts = (0, -1, 1000, 2**31, 2**63, 10**12, "x", "", "1.5", "nan")
    return {
        **{f"{count} vertices": ply(vertices=count) for count in counts},
        **{f"{count} faces": ply(faces=count) for count in counts if count != 0},
        **{f"x = {number}": ply(first=f"{number} -1 0.5 0 0") for number in ("nan", "inf", "1e39", "x", "1,5")},
        **{f"index {index}": ply(face=f"3 0 1 {index}") for index in (-1, 4, 10**6, 2**31, 2**63, "1.5", "nan", "x")},
        "corners": ply(face="255 0 1 2"),
        "no end": ply().replace(b"end_header\n", b""),
        "binary that says ascii": ply().replace(b"ascii", b"binary_little_endian"),
    }


def png(
    width: int, height: int, *, depth: int = 8, color: int = 2, body: bytes | None = None, more: bytes = b""
) -> bytes:
    """A PNG made by hand; black unless a body is given."""
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    lines = zlib.compress(bytes(min(1 + 4 * width * depth // 8, 1000)) * min(height, 1000)) if body is None else body
    parts = ((b"IHDR", header), *([(more[:4], more[4:])] if more else []), (b"IDAT", lines), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def pictures() -> dict[str, bytes]:
    """Predictions that are no 8-bit sRGB PNG of 8 x 8 pixels."""

    def saved(mode: str, kind: str = "PNG") -> bytes:
        buffer = io.BytesIO()
        Image.new(mode, (8, 8)).save(buffer, format=kind)
        return buffer.getvalue()

    return {
        "transparent": saved("RGBA"),
        "JPEG": saved("RGB", "JPEG"),
        "EPS": saved("RGB", "EPS"),
        "16 bits": png(8, 8, depth=16),
        "7 x 8": png(7, 8),
        "30000 x 30000": png(30_000, 30_000),
        "2^31 by 2^31": png(2**31 - 1, 2**31 - 1),
        "garbage": png(8, 8, body=b"garbage"),
        "text that is a bomb": png(8, 8, more=b"zTXta\0\0" + zlib.compress(bytes(50_000_000))),
    }


class Bomb:
    """Unpickled, it calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def states(good: bytes) -> dict[str, bytes]:
    """Weights whose pickles would run code, archives that lie, and states that are no renderer."""
    state = torch.load(io.BytesIO(good), weights_only=True)
    plain = {key: value for key, value in state.items() if key not in ("sha256", "version")}
    renderer = plain["renderer"]
    name = next(key for key, value in sorted(renderer.items()) if value.is_floating_point() and value.ndim == 2)
    bomb = Bomb(os.system, f"touch {MARK}")

    def saved(state: Any) -> bytes:
        buffer = io.BytesIO()
        torch.save(state, buffer)
        return buffer.getvalue()

    def signed(change: dict[str, Any], version: Any = CHECKPOINT_VERSION) -> bytes:
        content = {"version": version, **plain, **change}
        return saved({**content, "sha256": fingerprint(content)})

    def bombed() -> bytes:
        buffer = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(good)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
            for item in old.infolist():
                new.writestr(item.filename, bytes(20_000_000) if item.filename.endswith("/0") else old.read(item))
        return buffer.getvalue()

    return {
        "code": saved(bomb),
        "code of eval": saved({"a": Bomb(eval, f"open({MARK!r}, 'w')")}),
        "code in a plain pickle": pickle.dumps(bomb),
        "code beside good weights": saved({**state, "more": bomb}),
        "nothing": saved(None),
        "a wrong hash": saved({**state, "sha256": "0" * 64}),
        "version 2": signed({}, 2),
        "another config": signed({"config": {**plain["config"], "steps": 99}}),
        "a tensor less": signed({"renderer": {key: value for key, value in renderer.items() if key != name}}),
        "a tensor of another shape": signed({"renderer": {**renderer, name: torch.ones(2, 3, 4)}}),
        "a tensor of NaN": signed({"renderer": {**renderer, name: torch.full_like(renderer[name], torch.nan)}}),
        "a zip bomb": bombed(),
    }


def cases_of(root: Path) -> list[Case]:
    """Every hostile file of a world, in a fixed order."""
    cases = []
    rng = np.random.default_rng(7)
    for path in READERS:
        good, suffix = (root / path).read_bytes(), Path(path).suffix
        cuts = {f"cut to {size}": good[:size] for size in np.linspace(1, len(good) - 1, 10).astype(int)}
        bad = {
            ".json": lambda good=good: text_contents(good),
            ".pt": lambda good=good, cuts=cuts: states(good) | cuts,
            ".png": pictures,
            ".exr": lambda cuts=cuts: cuts,
            ".ply": lambda cuts=cuts: plies() | cuts,
        }[suffix]()
        loose: list[tuple[str, bytes]] = list(json_contents(good)) if suffix == ".json" else []
        for number in range(0 if suffix == ".json" else 40):
            spoilt = bytearray(good)
            spoilt[int(rng.integers(len(good)))] ^= 1 << int(rng.integers(8))
            loose.append((f"bit {number} flipped", bytes(spoilt)))
        not_files = {} if suffix == ".exr" else NOT_FILES  # Which is read as bytes.
        for name, content in (*not_files.items(), *bad.items()):
            cases.append(Case(name=f"{path} {name}", path=path, content=content, is_bad=True))
        cases += [Case(name=f"{path} {name}", path=path, content=content) for name, content in loose]
    return cases
