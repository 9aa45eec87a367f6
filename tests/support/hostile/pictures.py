"""Hostile pictures: predictions that are no 8-bit sRGB PNG of the right size, and EXR files that lie."""

import io
import struct
import zlib

import numpy as np
from PIL import Image
from support.hostile.jsons import Case, named

PREDICTION = "runs/one/foreign/predictions/interpolating/0000.png"


def chunk(kind: bytes, data: bytes, *, good: bool = True) -> bytes:
    """A part of a PNG, with a checksum that may be wrong."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data) ^ (not good))


def png(
    width: int,
    height: int,
    *,
    depth: int = 8,
    color: int = 2,
    interlace: int = 0,
    method: int = 0,
    body: bytes | None = None,
    more: bytes = b"",
) -> bytes:
    """A PNG made by hand; black unless a body is given."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(color, 3)
    line = b"\x00" + bytes(min(-(-width * channels * depth // 8), 1000))
    header = struct.pack(">IIBBBBB", width, height, depth, color, method, 0, interlace)
    data = zlib.compress(line * min(height, 1000)) if body is None else body
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + more + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def saved(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()


def picture_cases(good: bytes) -> list[Case]:
    """Predictions of an 8 x 8 view; `good` is what is none of them."""
    size = (8, 8)
    gradient = Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
    palette = gradient.quantize(4)
    contents = {
        "good": good,
        "good grey": saved(Image.new("L", size, 77)),
        "good palette": saved(palette),
        "good opaque alpha": saved(Image.new("RGBA", size, (1, 2, 3, 255))),
        "transparent": saved(Image.new("RGBA", size, (1, 2, 3, 0))),
        "grey with alpha": saved(Image.new("LA", size, (1, 2))),
        "palette with transparency": saved(palette, transparency=0),
        "16 bits grey": saved(Image.fromarray(np.full(size, 300, np.uint16))),
        "16 bits colour": png(8, 8, depth=16),
        "1 bit": saved(Image.new("1", size)),
        "interlaced": png(8, 8, interlace=1),
        "width 0": png(0, 8),
        "7 x 8": png(7, 8),
        "30000 x 30000": png(30_000, 30_000),
        "2^31 by 2^31": png(2**31 - 1, 2**31 - 1),
        "body of garbage": png(8, 8, body=b"garbage"),
        "body too long": png(8, 8, body=zlib.compress(bytes(100_000))),
        "body that is a bomb": png(8, 8, body=zlib.compress(bytes(50_000_000))),
        "text that is a bomb": png(8, 8, more=chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(50_000_000)))),
        "profile of garbage": png(8, 8, more=chunk(b"iCCP", b"a\0\0garbage")),
        "wrong checksum of the header": good[:29] + bytes([good[29] ^ 1]) + good[30:],
        "two headers": png(8, 8, more=chunk(b"IHDR", struct.pack(">IIBBBBB", 9, 9, 8, 2, 0, 0, 0))),
        "unknown critical part": png(8, 8, more=chunk(b"ABCD", b"x")),
        "wrong checksum of a part": png(8, 8, more=chunk(b"tEXt", b"a\0b", good=False)),
        "animated": saved(gradient, save_all=True, append_images=[Image.new("RGB", size)]),
        "JPEG": saved(gradient, "JPEG"),
        "GIF": saved(gradient.quantize(8), "GIF"),
        "EPS": saved(gradient, "EPS"),
        "signature alone": good[:8],
        "bytes after the end": good + b"more",
    }
    for length in np.linspace(9, len(good) - 1, 15).astype(int):
        contents[f"cut to {length}"] = good[:length]
    return named("png", "prediction", PREDICTION, contents)


def exr_cases(good: bytes) -> list[Case]:
    """Radiance whose record promises just these bytes."""
    rng = np.random.default_rng(3)
    contents = {
        "good": good,
        "empty": b"",
        "zeros": bytes(400),
        "text": b"not rendered",
        "magic alone": good[:4],
        "a PNG": png(8, 8),
        "bytes after the end": good + b"more",
    }
    for length in np.linspace(8, len(good) - 1, 12).astype(int):
        contents[f"cut to {length}"] = good[:length]
    for number in range(12):
        spoilt = bytearray(good)
        # The header: names of channels, the window, the compression.
        for place in rng.integers(4, 300, 3):
            spoilt[int(place)] ^= 1 << int(rng.integers(8))
        contents[f"header spoilt {number}"] = bytes(spoilt)
    return named("exr", "exr", "view.exr", contents)
