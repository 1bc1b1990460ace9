"""Models read back: an OBJ or GLB -> mesh, uv and texels; and meshes without texture.

Several textures, as an atlas of several pages has, become one: a grid of the images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from advtex_engine.core.errors import EngineError
from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_scan.errors import MeshError
from advtex_scan.mesh import MeshSource, MeshSurface, open_gltf, parse_mesh

MAX_SIDE = 16384
"""Texels: the largest side of a texture that is put together from pages."""
UV_SLACK = 1e-3
"""How far uv may lie outside of the texture; beyond, it is meant to repeat, which is not supported."""


class ModelError(EngineError):
    """The model cannot be read; the message names the file and the remedy."""


def load_model(path: Path) -> tuple[Atlas, Tensor]:
    """A textured model as it lies in the file, and its texture [H,W,3] uint8 sRGB.

    OBJ: coordinates as they stand. GLB: the default scene, moved by its nodes, thus +Y up. Of several textures, those
    that faces use are laid out as pages of one. Raises ModelError for a file that cannot be read, has no uv or no
    texture, or whose textures differ in size or are larger together than MAX_SIDE.
    """
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".glb"):
        raise ModelError(f"{path}: only OBJ and GLB models are read; export the model as one of them")
    with _reading(path):
        surface = _surface(path)
        mesh = to_mesh(surface)
        images = _obj_images(path) if suffix == ".obj" else _glb_images(path)
    if mesh.v_uv is None:
        raise ModelError(f"{path}: not every face has texture coordinates; unwrap the model first")
    if float(mesh.v_uv.min()) < -UV_SLACK or float(mesh.v_uv.max()) > 1 + UV_SLACK:
        raise ModelError(f"{path}: the texture repeats (uv outside of [0, 1]); bake the model into one atlas first")
    with _reading(path):
        if len(set(images.values())) == 1:
            image = _decode(path, next(iter(images.values())))
            return Atlas(mesh, image.shape[1], image.shape[0], "scan", 0), image
        return _paged(path, mesh, surface, images)


def load_reference(path: Path) -> Mesh:
    """The mesh of a PLY, OBJ or GLB file as it lies in the file. Raises ModelError when it cannot be read."""
    if path.suffix.lower() not in (".ply", ".obj", ".glb"):
        raise ModelError(f"{path}: only PLY, OBJ and GLB meshes are read; export the mesh as one of them")
    with _reading(path):
        return to_mesh(_surface(path))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ModelError(f"{error.filename or path}: cannot be read ({error.strerror or error})") from error
    except MeshError as error:
        raise ModelError(str(error)) from error


@contextmanager
def _source(path: Path) -> Iterator[MeshSource]:
    with path.open("rb") as stream:
        yield MeshSource(str(path), stream, path.stat().st_size, lambda name, _limit: Path(name).read_bytes())


def _surface(path: Path) -> MeshSurface:
    with _source(path) as source:
        return parse_mesh(source, NUMPY)


def _materials(surface: MeshSurface) -> tuple[list[str], Tensor]:
    """The names of the materials that triangles use, in the file's order, and each triangle's [T], as its place there.

    Those of a GLB are numbers, in their order.
    """
    runs = list[tuple[str, int]]()
    for part in surface.parts:
        ends = [*part.materials, (len(part.triangles) // 3, "")]
        runs += [(name, after - first) for (first, name), (after, _) in pairwise(ends)]
    names = list(dict.fromkeys(name for name, _ in runs))
    if not surface.parts[0].v_up:
        names.sort(key=lambda name: int(name or -1))
    place = {name: number for number, name in enumerate(names)}
    places = torch.tensor([place[name] for name, _ in runs])
    used, of_triangle = torch.unique(
        places.repeat_interleave(torch.tensor([count for _, count in runs])), return_inverse=True
    )
    return [names[number] for number in used.tolist()], of_triangle


def _paged(path: Path, mesh: Mesh, surface: MeshSurface, images: Mapping[str, bytes]) -> tuple[Atlas, Tensor]:
    """The images that faces use as the pages of one texture. images: encoded, by the name of their material."""
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    names, of_face = _materials(surface)
    if not all(name in images for name in names):
        count = len(set(images.values()))
        raise ModelError(f"{path}: the model has {count} textures, and faces without one; bake it into one atlas")
    encoded = list(dict.fromkeys(images[name] for name in names))
    pages = [_decode(path, one) for one in encoded]
    height, width, _ = pages[0].shape
    count = math.ceil(math.sqrt(len(pages)))
    if len({page.shape for page in pages}) > 1 or max(height, width) * count > MAX_SIDE:
        raise ModelError(
            f"{path}: its {len(pages)} textures differ in size, or need more than {MAX_SIDE} texels side by side; bake "
            "it into one atlas"
        )
    texture = torch.zeros((height * count, width * count, 3), dtype=torch.uint8)
    for number, page in enumerate(pages):
        row, column = divmod(number, count)
        texture[row * height : (row + 1) * height, column * width : (column + 1) * width] = page
    page_of_face = torch.tensor([encoded.index(images[name]) for name in names])[of_face]
    keys = mesh.t_uv_idx * len(pages) + page_of_face[:, None]
    used, t_uv_idx = torch.unique(keys, return_inverse=True)
    page = used % len(pages)
    # Within the outermost texel centers, where bilinear sampling leaves the neighboring page alone.
    half = 0.5 / torch.tensor([width, height])
    inside = mesh.v_uv[used // len(pages)].clamp(half, 1 - half)
    v_uv = (inside + torch.stack((page % count, page // count), 1)) / count
    atlas = Atlas(replace(mesh, v_uv=v_uv, t_uv_idx=t_uv_idx), width * count, height * count, "scan", 0, count)
    return atlas, texture


def _obj_images(path: Path) -> dict[str, bytes]:
    """Encoded textures by the material that shows them."""
    files = dict[str, Path]()
    for library in _values(path.read_bytes(), b"mtllib"):
        material = ""
        for line in (path.parent / library).read_bytes().splitlines():
            material = next(iter(_values(line, b"newmtl")), material)
            for name in _values(line, b"map_Kd"):
                # Options of the map stand before its name.
                image = path.parent / name
                files[material] = image if image.is_file() else path.parent / name.split()[-1]
    if not files:
        raise ModelError(f"{path}: the model has no texture; name one in its MTL file")
    return {material: file.read_bytes() for material, file in files.items()}


def _values(text: bytes, key: bytes) -> list[str]:
    """What follows `key` on the lines that begin with it."""
    lines = (line.strip() for line in text.splitlines())
    return [line[len(key) :].decode("latin-1").strip() for line in lines if line.startswith((key + b" ", key + b"\t"))]


def _glb_images(path: Path) -> dict[str, bytes]:
    """Encoded textures by the number of the material that shows them."""
    with _source(path) as source:
        document, binary = open_gltf(source)
    images = dict[str, bytes]()
    try:
        for number, material in enumerate(document.get("materials", [])):
            if "baseColorTexture" not in material.get("pbrMetallicRoughness", {}):
                continue
            texture = document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
            view = document["bufferViews"][document["images"][texture["source"]]["bufferView"]]
            start = view.get("byteOffset", 0)
            images[str(number)] = (binary or b"")[start : start + view["byteLength"]]
    except (LookupError, TypeError) as error:
        raise ModelError(f"{path}: the texture is not stored in the GLB; export it with images embedded") from error
    if not images:
        raise ModelError(f"{path}: the model has no texture; export it with images embedded")
    return images


def _decode(path: Path, data: bytes) -> Tensor:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise ModelError(f"{path}: its texture is not an image that can be read; save it as PNG or JPEG")
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1]))
