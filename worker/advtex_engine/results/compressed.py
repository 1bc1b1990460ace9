"""The GLB made smaller by extensions of glTF that not every viewer takes: Draco for faces, WebP for images.

Both are made from the GLB that is there, for the same texels and the same faces. What is not made, and why:

Meshopt (EXT_meshopt_compression) needs an encoder (`meshoptimizer` of PyPI is one), quantized attributes, and a decoder
that model-viewer does not have by itself. It is out: gltfpack made 2.7 MB of a kitchen's GLB of 4.5 MB with steps of 14
and 12 bits, and Draco 2.4 MB with finer ones.
KTX2 (KHR_texture_basisu) needs an encoder of Basis Universal (`alktx2` of PyPI is one) and a transcoder, which
model-viewer fetches from another host. It is out: it saves memory of the GPU, but of the same texels ETC1S has 38 dB
in half of a JPEG's bytes, which has 46, and UASTC takes three times as many.
"""

from __future__ import annotations

import importlib
import json
import struct
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.errors import OptionError
from advtex_engine.core.scene import Atlas
from advtex_engine.render.pictures import to_bytes
from advtex_engine.results.pages import split_pages
from advtex_engine.runtime.files import atomic_file

DRACO, WEBP = "KHR_draco_mesh_compression", "EXT_texture_webp"
POSITION_BITS, UV_BITS, NORMAL_BITS = 16, 16, 10
"""Draco's steps: a 65,536th of the model's largest side, an eighth of a texel in an image of 8192, and under a degree.
Renders of a kitchen are within .0001 LPIPS of those of the GLB; with 14 bits within .0007, for 2 % of the bytes."""
COMPRESSION_LEVEL = 7
WEBP_QUALITY, LOSSLESS_WEBP = 95, 101
"""Renders of a kitchen with such an image are .0042 LPIPS from those with a PNG on the mean of views, for six tenths of
a JPEG's bytes; at 90 .0154, and at 100 .0036: WebP halves the chroma, whatever the quality is."""
NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}

Array = NDArray[Any]


def write_compressed(
    out: Path, atlas: Atlas, texture: Tensor, outputs: Set[str], *, lossless: bool = False, name: str = "model"
) -> tuple[Path, ...]:
    """Write those of `name`_draco.glb and `name`_webp.glb that `outputs` asks for, beside `name`.glb; -> their paths.

    texture, lossless: as `export_model` takes them.
    """
    files = [out / f"{name}_{word}.glb" for word in ("draco", "webp") if word in outputs]
    if "draco" in outputs:
        write_draco(files[0], out / f"{name}.glb")
    if "webp" in outputs:
        images = [page.image for page in split_pages(atlas, texture)]
        write_webp(files[-1], out / f"{name}.glb", images, lossless=lossless)
    return tuple(files)


def require_draco() -> None:
    """Raises OptionError where Draco's encoder is not installed."""
    try:
        importlib.import_module("DracoPy")
    except ImportError as error:
        message = "the output draco needs DracoPy, which is not installed where the engine runs"
        raise OptionError(f"{message}; install advtex[draco] there, or leave draco out of the outputs") from error


def write_draco(path: Path, glb: Path) -> None:
    """The GLB at `glb` with its faces and vertices compressed by Draco, on a grid of 16 bits; images are the same."""
    document, binary = read_glb(glb)
    parts = _Parts(document, binary)
    views = {number: parts.keep(number) for number in (image["bufferView"] for image in document["images"])}
    for image in document["images"]:
        image["bufferView"] = views[image["bufferView"]]
    for primitive in (primitive for mesh in document["meshes"] for primitive in mesh["primitives"]):
        _compress(document, binary, primitive, parts)
    _require(document, DRACO)
    parts.write(path)


def write_webp(path: Path, glb: Path, images: Sequence[Tensor], *, lossless: bool = False) -> None:
    """The GLB at `glb` with its materials' colors as WebP.

    images: of its materials, in their order, [H,W,3] uint8 sRGB or float in [0,1].
    """
    quality = [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS_WEBP if lossless else WEBP_QUALITY]
    document, binary = read_glb(glb)
    parts = _Parts(document, binary)
    encoded = dict[int, bytes]()
    for material, image in zip(document["materials"], images, strict=True):
        texture = document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
        source = texture.pop("source")
        texture["extensions"] = {WEBP: {"source": source}}
        document["images"][source]["mimeType"] = "image/webp"
        done, data = cv2.imencode(".webp", np.ascontiguousarray(to_bytes(image)[..., ::-1]), quality)
        assert done
        encoded[document["images"][source]["bufferView"]] = data.tobytes()
    for number in range(len(document["bufferViews"])):
        parts.keep(number, encoded.get(number))
    _require(document, WEBP)
    parts.write(path)


class _Parts:
    """The buffer views of a GLB that is being put together from another one."""

    def __init__(self, document: dict[str, Any], binary: bytes) -> None:
        self._document, self._binary = document, binary
        self._views, self._chunks, self._length = list[dict[str, Any]](), list[bytes](), 0

    def add(self, data: bytes, view: dict[str, Any]) -> int:
        """Append bytes; `view` tells what else is to be said of them. -> the number of their buffer view."""
        self._views.append({**view, "buffer": 0, "byteOffset": self._length, "byteLength": len(data)})
        self._chunks.append(data + b"\0" * (-len(data) % 4))
        self._length += len(self._chunks[-1])
        return len(self._views) - 1

    def keep(self, number: int, instead: bytes | None = None) -> int:
        """Append a buffer view of the other GLB as it is, or with other bytes. -> its number here."""
        view = self._document["bufferViews"][number]
        first = view.get("byteOffset", 0)
        return self.add(instead or self._binary[first : first + view["byteLength"]], view)

    def write(self, path: Path) -> None:
        document = {**self._document, "bufferViews": self._views, "buffers": [{"byteLength": self._length}]}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with atomic_file(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self._length))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", self._length, b"BIN\0") + b"".join(self._chunks))


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a GLB that the engine wrote."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length + 8 :]


def _compress(document: dict[str, Any], binary: bytes, primitive: dict[str, Any], parts: _Parts) -> None:
    import DracoPy

    arrays = {name: _array(document, binary, index) for name, index in primitive["attributes"].items()}
    known = {"POSITION", "NORMAL", "TEXCOORD_0"}
    data = DracoPy.encode(
        arrays["POSITION"],
        _array(document, binary, primitive["indices"]).reshape(-1, 3).astype(np.uint32),
        quantization_bits=POSITION_BITS,
        compression_level=COMPRESSION_LEVEL,
        tex_coord=arrays["TEXCOORD_0"].astype(np.float64),
        tex_coord_quantization_bits=UV_BITS,
        normals=arrays["NORMAL"].astype(np.float64),
        normal_quantization_bits=NORMAL_BITS,
        generic_attributes={name: array for name, array in arrays.items() if name not in known} or None,
    )
    # Draco numbers the attributes, and splits and drops vertices as it likes: what it made of them has to be read.
    made = DracoPy.decode(data)
    kinds = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 3}  # of Draco's attributes
    ids = dict[str, int]()
    for name, index in primitive["attributes"].items():
        found = made.get_attribute_by_type(kinds[name]) if name in kinds else made.get_attribute_by_name(name)
        ids[name] = found["unique_id"]
        accessor = document["accessors"][index]
        accessor.pop("bufferView")
        accessor["count"] = len(found["data"])
        if name == "POSITION":
            accessor |= {"min": found["data"].min(0).tolist(), "max": found["data"].max(0).tolist()}
    indices = document["accessors"][primitive["indices"]]
    indices.pop("bufferView")
    indices["count"] = made.faces.size
    indices["componentType"] = 5123 if len(made.points) < 65535 else 5125
    primitive["extensions"] = {DRACO: {"bufferView": parts.add(data, {}), "attributes": ids}}


def _array(document: dict[str, Any], binary: bytes, index: int) -> Array:
    """What an accessor holds, [N,C]; the engine writes a buffer view for each."""
    accessor = document["accessors"][index]
    first = document["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    columns = NUMBERS[accessor["type"]]
    count = accessor["count"] * columns
    return np.frombuffer(binary, TYPES[accessor["componentType"]], count, first).reshape(-1, columns)


def _require(document: dict[str, Any], extension: str) -> None:
    for key in ("extensionsUsed", "extensionsRequired"):
        document[key] = [*document.get(key, []), extension]
