"""Models read back: an OBJ or GLB with one texture -> mesh, uv and texels; and meshes without one."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from advtex_engine.errors import EngineError
from advtex_engine.gltf import BINARY_CHUNK, JSON_CHUNK, read_gltf
from advtex_engine.meshio import read_obj, read_ply
from advtex_engine.polygons import MeshFormatError, triangulate
from advtex_engine.scene import Atlas, Mesh

Texture = TypeVar("Texture", str, int)

UV_SLACK = 1e-3
"""How far uv may lie outside of the texture; beyond, it is meant to repeat, which is not supported."""


class ModelError(EngineError):
    """The model cannot be read; the message names the file and the remedy."""


def load_model(path: Path) -> tuple[Atlas, Tensor]:
    """A textured model as it lies in the file, and its texture [H,W,3] uint8 sRGB.

    OBJ: coordinates as they stand. GLB: the default scene, moved by its nodes, thus +Y up. Raises ModelError for a
    file that cannot be read, has no uv or not exactly one texture.
    """
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".glb"):
        raise ModelError(f"{path}: only OBJ and GLB models are read; export the model as one of them")
    with _reading(path):
        data = path.read_bytes()
        mesh = _mesh(path, data)
        image = _obj_texture(path, data) if suffix == ".obj" else _glb_texture(path, data)
    if mesh.v_uv is None:
        raise ModelError(f"{path}: not every face has texture coordinates; unwrap the model first")
    if float(mesh.v_uv.min()) < -UV_SLACK or float(mesh.v_uv.max()) > 1 + UV_SLACK:
        raise ModelError(f"{path}: the texture repeats (uv outside of [0, 1]); bake the model into one atlas first")
    return Atlas(mesh, image.shape[1], image.shape[0], "scan", 0), image


def load_reference(path: Path) -> Mesh:
    """The mesh of a PLY, OBJ or GLB file as it lies in the file. Raises ModelError when it cannot be read."""
    if path.suffix.lower() not in (".ply", ".obj", ".glb"):
        raise ModelError(f"{path}: only PLY, OBJ and GLB meshes are read; export the mesh as one of them")
    with _reading(path):
        return _mesh(path, path.read_bytes())


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ModelError(f"{error.filename or path}: cannot be read ({error.strerror or error})") from error
    except MeshFormatError as error:
        raise ModelError(f"{path}: the mesh {error}; export it again in triangles and without compression") from error


def _mesh(path: Path, data: bytes) -> Mesh:
    suffix = path.suffix.lower()
    if suffix == ".glb":
        return triangulate(read_gltf(data, path.name, lambda name: (path.parent / name).read_bytes()))
    return triangulate(read_ply(data) if suffix == ".ply" else read_obj(data))


def _obj_texture(path: Path, data: bytes) -> Tensor:
    names = set[str]()
    for library in _values(data, b"mtllib"):
        names |= set(_values((path.parent / library).read_bytes(), b"map_Kd"))
    name = _only(path, sorted(names))
    # Options of the map stand before its name.
    image = path.parent / name
    return _decode(path, (image if image.is_file() else path.parent / name.split()[-1]).read_bytes())


def _values(text: bytes, key: bytes) -> list[str]:
    """What follows `key` on the lines that begin with it."""
    lines = (line.strip() for line in text.splitlines())
    return [line[len(key) :].decode("latin-1").strip() for line in lines if line.startswith((key + b" ", key + b"\t"))]


def _glb_texture(path: Path, data: bytes) -> Tensor:
    chunks, offset = dict[int, bytes](), 12
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, offset)
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + length])
        offset += 8 + length
    document: dict[str, Any] = json.loads(chunks[JSON_CHUNK])
    try:
        used = {
            document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["source"]
            for material in document.get("materials", [])
            if "baseColorTexture" in material.get("pbrMetallicRoughness", {})
        }
        image = document["images"][_only(path, sorted(used))]
        view = document["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return _decode(path, chunks[BINARY_CHUNK][start : start + view["byteLength"]])
    except (LookupError, TypeError) as error:
        raise ModelError(f"{path}: the texture is not stored in the GLB; export it with images embedded") from error


def _only(path: Path, textures: Sequence[Texture]) -> Texture:
    if len(textures) != 1:
        raise ModelError(
            f"{path}: the model has {len(textures)} textures; exactly one is needed: bake it into one atlas"
        )
    return textures[0]


def _decode(path: Path, data: bytes) -> Tensor:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise ModelError(f"{path}: its texture is not an image that can be read; save it as PNG or JPEG")
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1]))
