"""Tests of commands on files that hang, crash or exhaust whatever reads them: one line, soon, and nothing is left."""

import importlib
import os
import random
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from support.foreign import add, use_of
from support.gltf import BOX, GltfBuilder
from support.hostile import png as png_of

from datagen.data.ply import write_ply
from datagen.disk.errors import HyalineError
from datagen.machine import processes
from hyaline_import.remarks import Remarks
from hyaline_import.source import READERS


@pytest.fixture(autouse=True)
def read_here() -> None:
    """Not here: each file is read in a process of its own."""


def png(width: int, height: int) -> bytes:
    """Grey zeros."""
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(width + 1)) for _ in range(height)) + packer.flush()
    return png_of(width, height, color=0, body=packed)


def textured(data: bytes) -> bytes:
    builder = GltfBuilder()
    pbr = {"baseColorTexture": use_of(builder, data), "metallicFactor": 0}
    return add(builder, "box", BOX, {"pbrMetallicRoughness": pbr}).glb()


def serialized(offset: int) -> bytes:
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(bytes(100)) + struct.pack("<QI", offset, 1)


def mitsuba(inside: str) -> bytes:
    return f'<scene version="3.0.0">{inside}</scene>'.encode()


SELF = '<bsdf type="twosided" id="a"><ref id="{}"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>'
SERIALIZED = '<shape type="serialized"><string name="filename" value="b"/></shape>'
CUBE = '<shape type="cube"><ref id="a"/></shape>'

HOSTILE: dict[str, tuple[str, Callable[[], bytes]]] = {
    "a BSDF that holds itself": ("a.xml", lambda: mitsuba(SELF.format("a") + CUBE)),
    "two BSDFs that hold each other": ("a.xml", lambda: mitsuba(SELF.format("b") + CUBE)),
    "an offset of 2^63": ("a.xml", lambda: mitsuba(SERIALIZED)),
    "an STL of newlines": ("a.stl", lambda: b"solid\n" + b"\n" * 300_000),
    "an STL of blanks": ("a.stl", lambda: b"solid\n" + b" " * 300_000 + b"vertex" + b"\t" * 300_000),
    "an image of 67 M pixels": ("a.glb", lambda: textured(png(8192, 8192))),
    "an image of one line": ("a.glb", lambda: textured(png(1 << 26, 1))),
}


def place(name: str, folder: Path) -> Path:
    file, make = HOSTILE[name]
    (folder / "b").write_bytes(serialized(1 << 63))
    (folder / file).write_bytes(make())
    return folder / file


def command(*words: object, cwd: Path) -> tuple[subprocess.CompletedProcess[str], float, int]:
    """A command as it is typed; its CPU seconds, and the most memory that a process of it held.

    The helper between is its only parent, so that nothing else counts.
    """
    program = (
        "import resource, subprocess, sys\n"
        "status = subprocess.run([sys.executable, '-m', 'datagen', *sys.argv[1:]]).returncode\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print('used', used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == 'darwin' else 1024))\n"
        "sys.exit(status)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        cwd=cwd, capture_output=True, text=True, timeout=240, env={**os.environ, "TMPDIR": str(cwd)}, check=False,
    )  # fmt: skip
    _, seconds, peak = answer.stdout.strip().splitlines()[-1].split()
    return answer, float(seconds), int(peak)


def left(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith("hyaline-")]


QUICK = ("an STL of blanks", "an image of one line")


@pytest.mark.promise("R6")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.full) for name in HOSTILE]
)
def test_import_ends_soon_with_one_line_and_little_memory(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    answer, seconds, peak = command("import", path.name, "--out", "scene", cwd=tmp_path)
    assert "Traceback" not in answer.stderr
    if answer.returncode:
        lines = answer.stderr.strip().splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: ") and path.name[:1] in lines[0], answer.stderr
        assert not (tmp_path / "scene").exists()
    assert seconds < 12
    assert peak < 2_000_000_000
    assert not left(tmp_path)


ENDS = """
import os, sys
import numpy as np

def spin(folder):
    while True:
        pass

def crash(folder):
    os.kill(os.getpid(), 11)

def stumble(folder):
    raise IndexError("list index out\\nof range")

def hoard(folder):
    held = []
    while True:
        held.append(np.zeros(10_000_000))

def leave(folder):
    sys.exit(7)
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("spin", "x.glb: reading it took too much CPU time"),
        ("crash", r"x.glb: its reader was ended by SIGSEGV"),
        ("stumble", r"x.glb: cannot be read \(IndexError: list index out of range\); the file is damaged"),
        ("hoard", "x.glb: needs more than 2.0 GB of memory"),
        ("leave", "x.glb: its reader ended with status 7"),
    ],
)
def test_whatever_ends_a_reader_is_one_error(
    name: str, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "ends_of_readers.py").write_text(ENDS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.delitem(sys.modules, "ends_of_readers", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(processes, "CPU_S", 2)
    function = getattr(importlib.import_module("ends_of_readers"), name)
    with pytest.raises(HyalineError, match=message) as error, processes.confined(function, where="x.glb"):
        pass
    assert "\n" not in str(error.value)
    assert not left(tmp_path)


@pytest.mark.promise("R6", "R11")
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.full)])
def test_a_signal_ends_the_reader_and_leaves_no_scratch_folder(number: signal.Signals, tmp_path: Path) -> None:
    """The file takes minutes, and is allowed to: it is large."""
    text = b"solid\n" + b"facet\nvertex 1 2 3\nvertex 1 2 4\nvertex 1 3 5\nendfacet\n" * 900_000 + b"endsolid\n"
    (tmp_path / "a.stl").write_bytes(text)
    command = subprocess.Popen(
        [sys.executable, "-m", "datagen", "import", "a.stl"],
        cwd=tmp_path, env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while command.poll() is None and not ((reader := left(tmp_path)) and readers_of(reader[0])):
        time.sleep(0.05)
    assert command.returncode is None
    command.send_signal(number)
    _, said = command.communicate(timeout=60)
    assert command.returncode == 128 + number
    assert "Traceback" not in said
    assert not readers_of(reader[0])
    assert not left(tmp_path)


def readers_of(scratch: str) -> list[int]:
    """Processes that were started for a scratch folder."""
    listed = subprocess.run(["ps", "-ww", "-eo", "pid,args"], capture_output=True, text=True, check=True).stdout
    return [int(line.split()[0]) for line in listed.splitlines() if scratch in line]


def seeds() -> dict[str, bytes]:
    """A small file of each format that is read."""
    obj = b"mtllib a.mtl\nusemtl m\n" + b"".join(b"v %g %g %g\n" % tuple(p) for p in BOX.vertices)
    obj += b"".join(b"f %d %d %d\n" % tuple(f + 1) for f in BOX.faces)
    box = trimesh.Trimesh(BOX.vertices, BOX.faces, process=False)
    builder = add(GltfBuilder(), "box")
    shape = '<shape type="cube"><bsdf type="dielectric"/></shape><shape type="sphere"><bsdf type="diffuse"/></shape>'
    return {
        "a.glb": builder.glb(),
        "a.gltf": builder.gltf(),
        "a.obj": obj,
        "a.ply": write_ply(BOX),
        "a.stl": box.export(file_type="stl"),
        "b.stl": box.export(file_type="stl_ascii").encode(),
        "a.xml": mitsuba(shape + '<sensor type="perspective"/><emitter type="constant"/>'),
    }


NUMBERS = [b"-1", b"0", b"1e400", b"nan", b"4294967296", b"9223372036854775808", b"0.5", b"", b"\xc2\xb2"]


def changed(data: bytes, rng: random.Random) -> bytes:
    """A file with some bytes flipped, cut off, twice there, or with other numbers."""
    kind = rng.randrange(4)
    if kind == 0:
        return data[: rng.randrange(len(data))]
    if kind == 1:
        start, end = sorted(rng.randrange(len(data)) for _ in range(2))
        return data[:end] + data[start:]
    found = bytearray(data)
    if kind == 2:
        for _ in range(rng.randrange(1, 6)):
            found[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(found)
    spans = [match.span() for match in re.finditer(rb"\d+", data)]
    start, end = rng.choice(spans)
    return data[:start] + rng.choice(NUMBERS) + data[end:]


@pytest.mark.promise("R6")
def test_readers_refuse_changed_files_in_words_of_ours(tmp_path: Path, is_full: bool) -> None:
    rng = random.Random(26)
    surprises = []
    for name, data in seeds().items():
        path = tmp_path / name
        for _ in range(120 if is_full else 60):
            path.write_bytes(changed(data, rng))
            try:
                READERS.find(path.suffix[1:])(path, Remarks())
            except HyalineError as error:
                surprises += [f"{name}: {error}"] * ("\n" in str(error))
            except Exception as error:
                surprises.append(f"{name}: {type(error).__name__}: {error}")
    assert not surprises
