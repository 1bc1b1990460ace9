"""Image headers."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from advtex_scan import ImageError, open_scan, read_image_header


def header(tmp_path, content: bytes):
    (tmp_path / "image").write_bytes(content)
    with open_scan(tmp_path) as archive:
        return read_image_header(archive, "image")


@pytest.mark.parametrize(
    ("suffix", "shape", "kind"),
    [
        (".png", (48, 64, 3), np.uint8),
        (".png", (7, 5), np.uint8),
        (".png", (480, 640), np.uint16),
        (".jpg", (48, 64, 3), np.uint8),
        (".jpg", (7, 5), np.uint8),
    ],
)
def test_headers_of_images_that_opencv_wrote(tmp_path, suffix, shape, kind):
    rng = np.random.default_rng(0)
    _, encoded = cv2.imencode(suffix, rng.integers(0, 255, shape).astype(kind))
    found = header(tmp_path, encoded.tobytes())
    assert (found.height, found.width) == shape[:2]
    assert found.channels == (shape[2] if len(shape) == 3 else 1)
    assert found.bits == np.dtype(kind).itemsize * 8
    assert found.format == {".png": "png", ".jpg": "jpeg"}[suffix]


def test_a_jpeg_whose_size_comes_late(tmp_path, make):
    found = header(tmp_path, make.jpeg(1296, 968, before=b"profile" * 60_000))
    assert (found.width, found.height) == (1296, 968)


def test_huge_images_are_refused_from_their_header(tmp_path, make):
    assert header(tmp_path, make.png(8000, 8000)).width == 8000
    with pytest.raises(ImageError, match="15000x15000 pixels; at most 64 megapixels"):
        header(tmp_path, make.png(15000, 15000))
    with pytest.raises(ImageError, match="65535x65535"):
        header(tmp_path, make.jpeg(65535, 65535))


def bad_png(**fields: int) -> bytes:
    values = {"width": 4, "height": 4, "bits": 8, "color": 2, **fields}
    data = b"IHDR" + struct.pack(
        ">IIBBBBB", values["width"], values["height"], values["bits"], values["color"], 0, 0, 0
    )
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + data + struct.pack(">I", zlib.crc32(data)) + bytes(20)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"hello world" * 100, "neither PNG nor JPEG"),
        (bad_png()[:30], "cut off"),
        (bad_png(width=0), "makes no sense"),
        (bad_png(bits=3), "makes no sense"),
        (bad_png(color=9), "makes no sense"),
        (bad_png()[:20] + b"\xff" + bad_png()[21:], "damaged"),
        (b"\xff\xd8\xff", "cut off"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "cut off"),
        (b"\xff\xd8\xff\xda" + bytes(100), "without a size"),
        (b"\xff\xd8" + bytes(100), "damaged"),
    ],
)
def test_what_is_no_image_says_so(tmp_path, content, message):
    with pytest.raises(ImageError, match=message) as caught:
        header(tmp_path, content)
    assert caught.value.findings[0].where == "image"
    assert caught.value.findings[0].remedy
