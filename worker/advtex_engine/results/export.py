"""The textured model as files: OBJ + MTL + PNG, and GLB.

OBJ keeps the scan's world coordinates; its v counts from the image's bottom row, so v is flipped here, once.
glTF is +Y up: the GLB's node turns the scan's up axis there and leaves the vertices as they are; its uv has the
same origin as ours. Both carry smooth normals, and one material and sRGB PNG for each page of the atlas.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.scene import TO_Y_UP, Atlas, Mesh
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.runtime.files import atomic_file, write_atomically

Array = NDArray[Any]

LINES_PER_BLOCK = 1 << 16
"""OBJ lines formatted at once: bounds the memory of an export."""
GLTF_FLOAT, GLTF_UINT16, GLTF_UINT32 = 5126, 5123, 5125
GLTF_ARRAY_BUFFER, GLTF_ELEMENT_ARRAY_BUFFER = 34962, 34963
GLTF_LINEAR, GLTF_LINEAR_MIPMAP_LINEAR, GLTF_CLAMP = 9729, 9987, 33071


def export_model(out: Path, atlas: Atlas, texture: Tensor, *, up_axis: str, name: str = "model") -> tuple[Path, ...]:
    """Write `name`.obj, .mtl, .png and .glb into the folder `out`; returns their paths.

    texture: [atlas.height,atlas.width,3] uint8 sRGB, or float in [0,1] (clamped). Pages after the first are
    `name`_2.png and so on; a page without faces is left out. Each file is whole or absent; the OBJ comes after the
    files that it names.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    assert up_axis in TO_Y_UP
    out.mkdir(parents=True, exist_ok=True)
    normals = vertex_normals(_on_cpu(atlas.mesh))
    pages = _split_pages(atlas, texture)
    obj, mtl, glb = (out / f"{name}.{suffix}" for suffix in ("obj", "mtl", "glb"))
    images = [out / f"{name}{page.suffix}.png" for page in pages]
    for image, page in zip(images, pages, strict=True):
        write_atomically(image, page.png)
    write_atomically(mtl, "\n".join(map(_mtl, pages, images)).encode())
    _write_obj(obj, pages, normals, mtl.name)
    _write_glb(glb, pages, normals, up_axis)
    return obj, mtl, *images, glb


@dataclass(frozen=True)
class _Page:
    """An image and the faces that it covers. mesh: all vertices, and all uv as they lie on their own page."""

    mesh: Mesh
    png: bytes
    suffix: str

    @property
    def material(self) -> str:
        return f"textured{self.suffix}"


def _split_pages(atlas: Atlas, texture: Tensor) -> list[_Page]:
    mesh, count = _on_cpu(atlas.mesh), atlas.pages
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    assert atlas.width % count == 0
    assert atlas.height % count == 0
    cell = (mesh.v_uv * count).floor().clamp(0, count - 1)  # column and row
    v_uv = mesh.v_uv * count - cell
    page_of_uv = (cell[:, 1] * count + cell[:, 0]).long()
    face_page = page_of_uv[mesh.t_uv_idx]
    assert bool((face_page == face_page[:, :1]).all()), "a face crosses the border of its page"
    width, height = atlas.width // count, atlas.height // count
    pages = list[_Page]()
    for number in torch.unique(face_page[:, 0]).tolist():
        row, column = divmod(number, count)
        image = texture[row * height : (row + 1) * height, column * width : (column + 1) * width]
        mine = face_page[:, 0] == number
        part = Mesh(mesh.v_pos, mesh.t_pos_idx[mine], v_uv, mesh.t_uv_idx[mine])
        pages.append(_Page(part, encode_png(image), f"_{len(pages) + 1}" if pages else ""))
    return pages


def encode_png(texture: Tensor) -> bytes:
    """[H,W,3] uint8 sRGB, or float in [0,1], as a PNG."""
    image = texture.detach().cpu()
    if image.dtype != torch.uint8:
        image = (image.float().clamp(0, 1) * 255).round().to(torch.uint8)
    done, data = cv2.imencode(".png", np.ascontiguousarray(image.numpy()[..., ::-1]))
    assert done
    return data.tobytes()


def _on_cpu(mesh: Mesh) -> Mesh:
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    return Mesh(mesh.v_pos.cpu(), mesh.t_pos_idx.cpu(), mesh.v_uv.cpu(), mesh.t_uv_idx.cpu())


# OBJ


def _mtl(page: _Page, image: Path) -> str:
    """A material that shows the texture as it is: diffuse only (illum 1), no highlight."""
    return f"newmtl {page.material}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image.name}\n"


def _write_obj(path: Path, pages: Sequence[_Page], normals: Tensor, mtl: str) -> None:
    mesh = pages[0].mesh
    assert mesh.v_uv is not None
    uv = mesh.v_uv.double()
    flipped = torch.stack((uv[:, 0], 1 - uv[:, 1]), dim=1)
    with atomic_file(path) as file:
        file.write(f"mtllib {mtl}\nusemtl {pages[0].material}\n".encode())
        # Nine digits bring every float32 back exactly; six decimals are 1/500 of a texel at 2048.
        _write_lines(file, "v %.9g %.9g %.9g\n", mesh.v_pos.double())
        _write_lines(file, "vt %.7f %.7f\n", flipped)
        _write_lines(file, "vn %.4f %.4f %.4f\n", normals.double())
        for number, page in enumerate(pages):
            assert page.mesh.t_uv_idx is not None
            if number:
                file.write(f"usemtl {page.material}\n".encode())
            position, corner = page.mesh.t_pos_idx + 1, page.mesh.t_uv_idx + 1
            faces = torch.stack((position, corner, position), dim=2).view(-1, 9)
            _write_lines(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", faces)


def _write_lines(file: BinaryIO, line: str, rows: Tensor) -> None:
    for block in torch.split(rows, LINES_PER_BLOCK):
        file.write((line * len(block) % tuple(block.flatten().tolist())).encode())


# GLB


def _write_glb(path: Path, pages: Sequence[_Page], normals: Tensor, up_axis: str) -> None:
    """glTF 2.0 binary: a header, a JSON chunk and a binary chunk, each padded to four bytes."""
    document = _gltf(up_axis)
    chunks, offset = list[bytes](), 0

    def add_view(chunk: bytes, target: int | None) -> int:
        nonlocal offset
        view: dict[str, Any] = {"buffer": 0, "byteOffset": offset, "byteLength": len(chunk)}
        document["bufferViews"].append(view | ({"target": target} if target else {}))
        chunks.append(chunk + b"\0" * (-len(chunk) % 4))
        offset += len(chunks[-1])
        return len(chunks) - 1

    for page in pages:
        arrays = _split_at_seams(page.mesh, normals)
        targets = (GLTF_ELEMENT_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER)
        views = [add_view(array.tobytes(), target) for array, target in zip(arrays, targets, strict=True)]
        _add_page(document, page, arrays, views, add_view(page.png, None))
    document["buffers"] = [{"byteLength": offset}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", offset, b"BIN\0"))
        for chunk in chunks:
            file.write(chunk)


def _gltf(up_axis: str) -> dict[str, Any]:
    """A document with a mesh that has no page yet."""
    node: dict[str, Any] = {"name": "model", "mesh": 0}
    if up_axis != "+y":
        node["rotation"] = TO_Y_UP[up_axis]
    sampler = {
        "magFilter": GLTF_LINEAR,
        "minFilter": GLTF_LINEAR_MIPMAP_LINEAR,
        "wrapS": GLTF_CLAMP,
        "wrapT": GLTF_CLAMP,
    }
    return {
        "asset": {"version": "2.0", "generator": "advtex"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "model", "primitives": []}],
        "materials": [],
        "textures": [],
        "samplers": [sampler],
        "images": [],
        "accessors": [],
        "bufferViews": [],
    }


def _add_page(
    document: dict[str, Any], page: _Page, arrays: tuple[Array, ...], views: Sequence[int], image: int
) -> None:
    """A primitive with its material, texture and image. arrays: of `_split_at_seams`, in the buffer views `views`."""
    indices, positions = arrays[:2]
    first, number = len(document["accessors"]), len(document["materials"])
    vector = {"componentType": GLTF_FLOAT, "count": len(positions), "type": "VEC3"}
    index_type = GLTF_UINT16 if indices.dtype == np.uint16 else GLTF_UINT32
    document["accessors"] += [
        {"bufferView": views[0], "componentType": index_type, "count": indices.size, "type": "SCALAR"},
        {"bufferView": views[1], **vector, "min": positions.min(0).tolist(), "max": positions.max(0).tolist()},
        {"bufferView": views[2], **vector},
        {"bufferView": views[3], **vector, "type": "VEC2"},
    ]
    attributes = {"POSITION": first + 1, "NORMAL": first + 2, "TEXCOORD_0": first + 3}
    document["meshes"][0]["primitives"].append({"attributes": attributes, "indices": first, "material": number})
    shading = {"baseColorTexture": {"index": number}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    document["materials"].append({"name": page.material, "pbrMetallicRoughness": shading, "doubleSided": True})
    document["textures"].append({"source": number, "sampler": 0})
    document["images"].append({"name": f"texture{page.suffix}", "bufferView": image, "mimeType": "image/png"})


def _split_at_seams(mesh: Mesh, normals: Tensor) -> tuple[Array, Array, Array, Array]:
    """Vertices that have one position and one uv each: glTF knows no separate indices.

    Returns indices [3T] (uint16 where they fit: 65535 is reserved), positions [N,3], normals [N,3], uv [N,2] float32.
    """
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    uv_count = len(mesh.v_uv)
    key = (mesh.t_pos_idx * uv_count + mesh.t_uv_idx).flatten()
    pairs, index = torch.unique(key, return_inverse=True)
    position, corner = pairs // uv_count, pairs % uv_count
    dtype = np.uint16 if len(pairs) < 65535 else np.uint32
    return (
        index.numpy().astype(dtype),
        mesh.v_pos[position].numpy().astype("<f4"),
        normals[position].numpy().astype("<f4"),
        mesh.v_uv[corner].numpy().astype("<f4"),
    )
