"""Bytes of a scan's files -> arrays: color, depth, confidence and masks as they are stored, and their rectification.

Whatever is wrong with the bytes is a ScanError that names the file and the remedy.
"""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.ingest.depth import Raw, inflate
from advtex_engine.render.texture import fill_holes
from advtex_scan.errors import ScanFormatError
from advtex_scan.images import MAX_PIXELS, cut_off, has_end, parse_image_header, place
from advtex_scan.manifest import ByteRange, FileRef, Intrinsics, VideoFrame

Color = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
FARTHEST_STORED = 65534  # of 16 bits; 65535 stands for no reading


def decode_color(data: bytes, ref: FileRef, intrinsics: Intrinsics, size: tuple[int, int], border: int = 0) -> Color:
    """A frame's color image as [height,width,3] uint8 sRGB, R first, rectified, at `size` = (width, height)."""
    return prepare_color(color_image(data, ref, intrinsics), ref, intrinsics, size, border)


def prepare_color(
    image: Color, ref: FileRef | VideoFrame, intrinsics: Intrinsics, size: tuple[int, int], border: int = 0
) -> Color:
    """A stored color image [h,w,3] rectified and resampled to `size` = (width, height)."""
    return shrink_color(rectify_color(image, ref, intrinsics, border), size)


def color_image(data: bytes, ref: FileRef, intrinsics: Intrinsics) -> Color:
    """A frame's color image as it is stored, [h,w,3] uint8 sRGB, R first.

    Any rotation that the file's metadata asks for is ignored: intrinsics and poses belong to the stored pixels.
    """
    if isinstance(ref, ByteRange) and ref.codec == "raw_rgb8":
        if len(data) != 3 * intrinsics.width * intrinsics.height:
            raise ScanError(broken(ref, f"does not hold {intrinsics.width}x{intrinsics.height} pixels"))
        return np.frombuffer(data, np.uint8).reshape(intrinsics.height, intrinsics.width, 3)
    bgr = _imdecode(data, ref, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def rectify_color(image: Color, ref: FileRef | VideoFrame, intrinsics: Intrinsics, border: int) -> Color:
    """A stored color image [h,w,3] as its `rectified` camera sees it. Raises ScanError unless it has its size."""
    check_size(ref, image, intrinsics)
    return rectify(image, intrinsics, border, cv2.INTER_LINEAR)


def shrink_color(image: Color, size: tuple[int, int]) -> Color:
    """An image [h,w,3] at `size` = (width, height), a copy.

    Shrunk by averaging over areas; the axes scale apart when the aspect ratio differs.
    """
    height, width = image.shape[:2]
    if (width, height) == size:
        return np.array(image)
    shrinks = size[0] <= width and size[1] <= height
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)


def decode_depth(data: bytes, ref: FileRef, intrinsics: Intrinsics, units_per_metre: float = 1000.0) -> Raw:
    """A frame's depth values, [height,width] uint16, as stored; floats, which are metres, in `units_per_metre`."""
    codec = ref.codec if isinstance(ref, ByteRange) else "png"
    width, height = intrinsics.width, intrinsics.height
    if codec == "raw_u16" and len(data) == 2 * width * height:
        return np.frombuffer(data, "<u2").reshape(height, width)
    if codec == "raw_u16":
        raise ScanError(broken(ref, f"does not hold {width}x{height} readings"))
    if codec == "zlib_u16":
        try:
            return inflate(data, width, height)
        except ValueError as error:
            raise ScanError(broken(ref, str(error))) from error
    if codec == "lzfse_f32":
        return _stored(
            np.frombuffer(_unpacked(data, ref, intrinsics, 4), "<f4").reshape(height, width), units_per_metre
        )
    if codec == "npy":
        return _stored(_array(data, ref, intrinsics), units_per_metre)
    image = _imdecode(data, ref, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise ScanError(broken(ref, "is not a depth image of one 16-bit channel"))
    check_size(ref, image, intrinsics)
    return image.astype(np.uint16, copy=False)


def decode_confidence(data: bytes, ref: FileRef, intrinsics: Intrinsics, most: int) -> npt.NDArray[np.float32]:
    """How far each depth reading is to be trusted, [height,width] float32 in [0, 1]; stored `most` means 1."""
    if isinstance(ref, ByteRange) and ref.codec == "lzfse_u8":
        unpacked = _unpacked(data, ref, intrinsics, 1)
        values = np.frombuffer(unpacked, np.uint8).reshape(intrinsics.height, intrinsics.width)
    else:
        values = _gray(data, ref, intrinsics)
    levels: npt.NDArray[np.float32] = np.minimum(values.astype(np.float32) / np.float32(most), np.float32(1))
    return levels


def decode_mask(data: bytes, ref: FileRef, intrinsics: Intrinsics) -> Mask:
    """Where a color image, as it is stored, may be used: [h,w]."""
    return np.asarray(_gray(data, ref, intrinsics) > 0)


def shrink_mask(mask: Mask, intrinsics: Intrinsics, size: tuple[int, int], border: int = 0) -> Mask:
    """A stored mask [h,w] rectified, at `size` = (width, height); a pixel counts if all that it averages does."""
    whole = rectify(mask.astype(np.float32), intrinsics, border, cv2.INTER_LINEAR)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA) > 0.999)


def fill_masked(image: Color, mask: Mask) -> Color:
    """A stored image [h,w,3] with the colors around in place of those that its mask [h,w] leaves out.

    So nothing that samples, filters or judges the image depends on them.
    """
    if not mask.any():
        return np.full_like(image, 128)
    filled = fill_holes(torch.from_numpy(image.astype(np.float32)), torch.from_numpy(mask))
    return np.asarray(filled.round().numpy().astype(np.uint8))


def rectified(intrinsics: Intrinsics, border: int = 0) -> Intrinsics:
    """The pinhole camera of an image after `rectify`."""
    camera = intrinsics
    if camera.distortion is not None:
        K, _ = cv2.getOptimalNewCameraMatrix(
            _matrix(camera), _coefficients(camera), (camera.width, camera.height), alpha=0
        )
        fx, fy, cx, cy = (float(K[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
        camera = Intrinsics(fx, fy, cx + 0.5, cy + 0.5, camera.width, camera.height)
    width, height = camera.width - 2 * border, camera.height - 2 * border
    return replace(camera, cx=camera.cx - border, cy=camera.cy - border, width=width, height=height)


def rectify(image: npt.NDArray[Any], intrinsics: Intrinsics, border: int, interpolation: int) -> npt.NDArray[Any]:
    """An image [h,w,...] without lens distortion and without `border` pixels along each edge.

    Of the undistorted image the largest part is kept that holds no pixel from outside the stored one.
    """
    if intrinsics.distortion is not None:
        K = _matrix(rectified(intrinsics))
        size = (intrinsics.width, intrinsics.height)
        maps = cv2.initUndistortRectifyMap(
            _matrix(intrinsics), _coefficients(intrinsics), np.eye(3), K, size, cv2.CV_32FC1
        )
        image = cv2.remap(image, maps[0], maps[1], interpolation, borderMode=cv2.BORDER_REPLICATE)
    return image[border : image.shape[0] - border, border : image.shape[1] - border]


def check_size(ref: FileRef | VideoFrame, image: npt.NDArray[Any], intrinsics: Intrinsics) -> None:
    """Raises ScanError unless the image has the size that its intrinsics are for."""
    height, width = image.shape[:2]
    if (width, height) != (intrinsics.width, intrinsics.height):
        raise ScanError(
            Problem(
                "image_size",
                place(ref),
                f"has {width}x{height} pixels, its intrinsics are for {intrinsics.width}x{intrinsics.height}",
                "give the intrinsics of the stored images",
            )
        )


def broken(ref: FileRef | VideoFrame, message: str) -> Problem:
    """What is said of a file that is not what it should be."""
    return Problem("not_an_image", place(ref), message, "replace it by a sound image, or leave the frame out")


def _matrix(camera: Intrinsics) -> npt.NDArray[np.float64]:
    """K as OpenCV counts pixels: the first one's centre at (0, 0)."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def _coefficients(camera: Intrinsics) -> npt.NDArray[np.float64]:
    bent = camera.distortion
    assert bent is not None
    return np.array([bent.k1, bent.k2, bent.p1, bent.p2, bent.k3])


def _imdecode(data: bytes, ref: FileRef, flags: int) -> npt.NDArray[Any]:
    """Decode a PNG or JPEG whose header claims a bearable size."""
    try:
        header = parse_image_header(data, place(ref))
    except ScanFormatError as error:
        raise ScanError(*_problems(error)) from error
    if header is None:
        raise ScanError(broken(ref, "is cut off: its size is missing"))
    if header.width * header.height > MAX_PIXELS:
        raise ScanError(
            Problem(
                "image_too_large",
                place(ref),
                f"claims {header.width}x{header.height} pixels; at most {MAX_PIXELS // 10**6} megapixels are accepted",
                "scale the images down",
            )
        )
    if not has_end(data, header):
        raise ScanError(*_problems(cut_off(place(ref))))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ScanError(broken(ref, "cannot be decoded")) from error
    if image is None:
        raise ScanError(broken(ref, "cannot be decoded"))
    return image


def _problems(error: ScanFormatError) -> list[Problem]:
    return [Problem(one.code, one.where, one.message, one.remedy) for one in error.findings]


def _gray(data: bytes, ref: FileRef, intrinsics: Intrinsics) -> Color:
    image = _imdecode(data, ref, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint8:
        raise ScanError(broken(ref, "is not an 8-bit image"))
    check_size(ref, image, intrinsics)
    return np.asarray(image if image.ndim == 2 else image[..., :3].max(-1), np.uint8)


def _unpacked(data: bytes, ref: FileRef, intrinsics: Intrinsics, bytes_each: int) -> bytes:
    """What an LZFSE stream holds. It is given no more room than it should need."""
    size = intrinsics.width * intrinsics.height * bytes_each
    try:
        values = imagecodecs.lzfse_decode(data, out=size + 1)
    except imagecodecs.LzfseError as error:
        raise ScanError(broken(ref, f"does not unpack ({error})")) from error
    if len(values) != size:
        raise ScanError(broken(ref, f"does not hold {intrinsics.width}x{intrinsics.height} values"))
    return bytes(values)


def _array(data: bytes, ref: FileRef, intrinsics: Intrinsics) -> npt.NDArray[Any]:
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ScanError(broken(ref, "is no NumPy array")) from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "uif":
        raise ScanError(broken(ref, "is no NumPy array of rows and columns of numbers"))
    check_size(ref, array, intrinsics)
    return array


def _stored(values: npt.NDArray[Any], units_per_metre: float) -> Raw:
    """Whole numbers as they are, metres in units; what does not fit into 16 bits is no reading."""
    units = values.astype(np.float64)
    if values.dtype.kind == "f":
        units = np.rint(units * units_per_metre)
    with np.errstate(invalid="ignore"):
        return np.where((units > 0) & (units <= FARTHEST_STORED), units, 0).astype(np.uint16)
