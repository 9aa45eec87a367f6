"""Tests that a prediction is scored as it was written or not at all: no flipped bit, cut or odd PNG gets through."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.commands import call
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset
from datagen.data.images import decode_png, png_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, commit_sealed
from datagen.disk.storage import sha256
from eval.score.runs import check_png, open_run, read_prediction, within

pytestmark = pytest.mark.promise("R4")

SIZE = 16


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The pane and the floor in 16 x 16 pixels, for reading only."""
    return write_synthetic_dataset(tmp_path_factory.mktemp("png") / "data" / "synthetic", resolution=SIZE)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    ramp = np.linspace(0, 255, SIZE).astype(np.uint8)
    return np.stack(np.broadcast_arrays(ramp[:, None], ramp[None], ramp[None, ::-1]), axis=-1)


def encode(image: Image.Image, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", **options)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def with_text(data: bytes) -> bytes:
    """The PNG with a chunk that no picture needs, as other programs write."""
    return data[:33] + chunk(b"tEXt", b"Software\0a renderer") + data[33:]


def read(data: bytes) -> np.ndarray:
    """The pixels of a PNG that passes."""
    picture = decode_png(data, where="it")
    check_png(data, where="it")
    return np.asarray(picture)


def test_every_flipped_bit_that_could_change_a_pixel_is_noticed_by_a_png_s_own_checksums(picture: np.ndarray) -> None:
    data = with_text(png_bytes(picture))
    for bit in range(8 * (len(data) - 12)):  # The last chunk, of 12 bytes, holds nothing.
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        with pytest.raises(HyalineError, match=r"^it: (damaged|not a PNG|is .* pixels|has .* bits)"):
            read(bytes(broken))
    assert np.array_equal(read(data), picture)


def test_a_png_that_is_cut_off_before_its_last_chunk_is_noticed(picture: np.ndarray) -> None:
    data = png_bytes(picture)
    for length in range(len(data) - 12):
        with pytest.raises(HyalineError, match=r"^it: (damaged|not a PNG)"):
            read(data[:length])


PLAIN = Image.new("RGB", (SIZE, SIZE))
ODD = {
    "16-bit grey": encode(Image.new("I;16", (SIZE, SIZE))),
    "bilevel": encode(Image.new("1", (SIZE, SIZE))),
    "transparent": encode(Image.new("RGBA", (SIZE, SIZE), (0, 0, 0, 9))),
    "transparent palette": encode(PLAIN.quantize(4), transparency=0),
    "no pixels": encode(PLAIN)[:33] + chunk(b"IEND", b""),
}


def profile(name: str) -> bytes:
    """An iCCP chunk whose profile names itself."""
    return chunk(b"iCCP", b"a profile\0\0" + zlib.compress(b"desc" + name.encode("utf-16-be") + bytes(100)))


PRIMARIES = struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)
SAID = {
    "nothing": b"",
    "sRGB": chunk(b"sRGB", b"\0"),
    "gamma": chunk(b"gAMA", struct.pack(">I", 45455)) + chunk(b"cHRM", PRIMARIES),
    "sRGB before a gamma": chunk(b"sRGB", b"\0") + chunk(b"gAMA", struct.pack(">I", 100_000)),
    "profile": profile("sRGB IEC61966-2.1"),
}
OTHER = {
    "linear": chunk(b"gAMA", struct.pack(">I", 100_000)),
    "wide": chunk(b"cHRM", struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)),
    "P3": profile("Display P3"),
    "linear sRGB": profile("GIMP built-in Linear sRGB"),
    "no profile": chunk(b"iCCP", b"sRGB\0\0sRGB"),
}


@pytest.mark.parametrize("name", {**SAID, **OTHER})
def test_only_pictures_that_are_srgb_pass(picture: np.ndarray, name: str) -> None:
    plain = png_bytes(picture)
    data = plain[:33] + {**SAID, **OTHER}[name] + plain[33:]
    if name in SAID:
        assert np.array_equal(read(data), picture)
    else:
        with pytest.raises(HyalineError, match=r"^it: its ICC profile, gAMA or cHRM chunk"):
            read(data)


def test_a_picture_that_is_a_link_to_elsewhere_is_refused(
    dataset: Dataset, tmp_path: Path, picture: np.ndarray
) -> None:
    folder = tmp_path / "runs/synthetic/linked/predictions/interpolating"
    folder.mkdir(parents=True)
    for view in range(dataset.num_views["interpolating"]):
        (tmp_path / f"{view}.png").write_bytes(png_bytes(picture))
        (folder / f"{view:04d}.png").symlink_to(tmp_path / f"{view}.png")
    line = f"eval report {tmp_path / 'runs'} --data {dataset.root.parent} --out {tmp_path / 'report'}"
    answer = call(line)
    assert answer.status == 1
    assert "interpolating: 0000.png is a link out of its folder; expected a file inside" in answer.error
    for path in folder.iterdir():
        path.unlink()
        path.write_bytes(png_bytes(picture))
    assert call(line).status == 0


def read_as_prediction(dataset: Dataset, folder: Path, data: bytes) -> np.ndarray:
    """A PNG as the report reads it from the folder of a foreign method."""
    path = folder / "synthetic/nerf/predictions/interpolating/0000.png"
    path.parent.mkdir(parents=True)
    path.write_bytes(data)
    return read_prediction(open_run(folder / "synthetic/nerf", dataset.root.parent), "interpolating", 0)


@pytest.mark.parametrize("name", ODD)
def test_an_odd_picture_is_refused_in_one_line(dataset: Dataset, tmp_path: Path, name: str) -> None:
    with pytest.raises(HyalineError, match=f"^{tmp_path}/synthetic/nerf/[^\n]*/0000.png: [^\n]*$"):
        read_as_prediction(dataset, tmp_path, ODD[name])


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "LA"])
def test_opaque_pictures_of_8_bits_are_read_whatever_their_kind(
    dataset: Dataset, picture: np.ndarray, tmp_path: Path, mode: str
) -> None:
    image = Image.fromarray(picture).quantize(9) if mode == "P" else Image.fromarray(picture).convert(mode)
    assert np.array_equal(
        read_as_prediction(dataset, tmp_path, with_text(encode(image))), np.asarray(image.convert("RGB"))
    )


# What hyaline wrote


def write_run(folder: Path, dataset: Dataset) -> None:
    """Perfect predictions with the list of their hashes."""
    files: dict[str, Json] = {}
    for view in range(2):
        path = folder / f"predictions/interpolating/000{view}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(png_bytes(dataset.view("interpolating", view).image))
        files[path.relative_to(folder).as_posix()] = sha256(path.read_bytes())
    commit_sealed(folder / "predictions.json", {"version": 1, "files": files})


@pytest.mark.parametrize(
    ("place", "command"),
    [
        (".", "model predict {root}/synthetic/paper"),
        ("variants/x2", "model predict {root}/synthetic/paper --variant x2"),
    ],
)
def test_a_picture_that_is_not_what_was_written_is_named_with_the_command_that_writes_it(
    dataset: Dataset, tmp_path: Path, place: str, command: str
) -> None:
    folder = tmp_path / "synthetic" / "paper" / place
    for each in (folder, tmp_path / "synthetic" / "paper"):
        write_run(each, dataset)
    path = folder / "predictions/interpolating/0001.png"
    run = open_run(tmp_path / "synthetic/paper", dataset.root.parent)
    run = run if place == "." else within(run, folder, dataset)
    assert np.array_equal(read_prediction(run, "interpolating", 1), dataset.view("interpolating", 1).image)

    data = path.read_bytes()
    other = png_bytes(dataset.view("interpolating", 0).image)  # A whole picture, but another one.
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 2
    for broken in (bytes(flipped), other, data + b"\0", data[:-1]):
        path.write_bytes(broken)
        with pytest.raises(HyalineError) as error:
            read_prediction(run, "interpolating", 1)
        told = command.format(root=tmp_path)
        assert str(error.value) == (
            f"{path}: damaged (checksum differs), according to {folder / 'predictions.json'}; "
            f"render it again with `{told}`"
        )
    assert np.array_equal(read_prediction(run, "interpolating", 0), dataset.view("interpolating", 0).image)


def test_a_picture_that_the_list_does_not_name_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "synthetic" / "paper"
    write_run(folder, dataset)
    path = folder / "predictions/extrapolating/0000.png"
    path.parent.mkdir()
    path.write_bytes(png_bytes(dataset.view("extrapolating", 0).image))
    with pytest.raises(HyalineError, match=r"0000\.png: not one of the run's pictures, according to"):
        read_prediction(open_run(folder, dataset.root.parent), "extrapolating", 0)
