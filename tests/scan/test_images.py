"""Image headers and ends."""

from __future__ import annotations

import struct
import zipfile
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_scan import ByteRange, ImageError, open_scan, read_image_header
from advtex_scan.images import LAST_BYTES, check_end


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
        (b"\x76\x2f\x31\x01\x02\0\0\0", "OpenEXR"),
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


@pytest.fixture(scope="module")
def whole() -> dict[str, bytes]:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    return {suffix: cv2.imencode(suffix, pixels)[1].tobytes() for suffix in (".png", ".jpg")}


def check(archive, ref) -> None:
    check_end(archive, ref, read_image_header(archive, ref))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_an_image_cut_off_anywhere_is_found(tmp_path, whole, suffix, data):
    content = whole[suffix]
    missing = data.draw(st.integers(9 if suffix == ".png" else 1, len(content)))
    (tmp_path / "image").write_bytes(content[:-missing])
    with open_scan(tmp_path) as archive, pytest.raises(ImageError) as caught:
        check(archive, "image")
    assert caught.value.findings[0].where == "image"
    assert caught.value.findings[0].remedy


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("more", [0, 100, LAST_BYTES + 100])
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED], ids=["stored", "deflated"])
def test_what_follows_the_end_of_an_image_does_no_harm(tmp_path, whole, suffix, more, method):
    with zipfile.ZipFile(tmp_path / "scan.zip", "w", method) as file:
        file.writestr("image", whole[suffix] + bytes(more))
        file.writestr("cut", whole[suffix][:-20] + bytes(more))
    with open_scan(tmp_path / "scan.zip") as archive:
        check(archive, "image")
        with pytest.raises(ImageError, match="cut: is cut off: its end is missing"):
            check(archive, "cut")


def test_the_end_of_a_range_is_looked_for_inside_of_it(tmp_path, whole):
    content = whole[".jpg"]
    (tmp_path / "stream").write_bytes(content * 2)
    with open_scan(tmp_path) as archive:
        check(archive, ByteRange("stream", len(content), len(content), "jpeg"))
        with pytest.raises(ImageError, match=rf"stream \(byte {len(content)}\): is cut off"):
            check(archive, ByteRange("stream", len(content), len(content) - 50, "jpeg"))
