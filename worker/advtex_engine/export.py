"""The textured model as files: OBJ + MTL + PNG, and GLB.

OBJ keeps the scan's world coordinates; its v counts from the image's bottom row, so v is flipped here, once.
glTF is +Y up: the GLB's node turns the scan's up axis there and leaves the vertices as they are; its uv has the
same origin as ours. Both carry one material, one sRGB PNG and smooth normals.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.files import atomic_file, write_atomically
from advtex_engine.scene import Atlas, Mesh

Array = NDArray[Any]

LINES_PER_BLOCK = 1 << 16
"""OBJ lines formatted at once: bounds the memory of an export."""
QUARTER = 0.5**0.5
TO_Y_UP: dict[str, tuple[float, float, float, float]] = {
    "+y": (0.0, 0.0, 0.0, 1.0),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "+z": (-QUARTER, 0.0, 0.0, QUARTER),
    "-z": (QUARTER, 0.0, 0.0, QUARTER),
    "+x": (0.0, 0.0, QUARTER, QUARTER),
    "-x": (0.0, 0.0, -QUARTER, QUARTER),
}
"""Rotation (x, y, z, w) that turns each axis to +y."""
GLTF_FLOAT, GLTF_UINT16, GLTF_UINT32 = 5126, 5123, 5125
GLTF_ARRAY_BUFFER, GLTF_ELEMENT_ARRAY_BUFFER = 34962, 34963
GLTF_LINEAR, GLTF_LINEAR_MIPMAP_LINEAR, GLTF_CLAMP = 9729, 9987, 33071


def export_model(out: Path, atlas: Atlas, texture: Tensor, *, up_axis: str, name: str = "model") -> tuple[Path, ...]:
    """Write `name`.obj, .mtl, .png and .glb into the folder `out`; returns their paths.

    texture: [atlas.height,atlas.width,3] uint8 sRGB, or float in [0,1] (clamped). Each file is whole or absent; the
    OBJ comes after the files that it names.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    assert up_axis in TO_Y_UP
    out.mkdir(parents=True, exist_ok=True)
    mesh = _on_cpu(atlas.mesh)
    normals = vertex_normals(mesh)
    png = encode_png(texture)
    paths = tuple(out / f"{name}.{suffix}" for suffix in ("obj", "mtl", "png", "glb"))
    obj, mtl, image, glb = paths
    write_atomically(image, png)
    write_atomically(mtl, _mtl(image.name).encode())
    _write_obj(obj, mesh, normals, mtl.name)
    _write_glb(glb, mesh, normals, png, up_axis)
    return paths


def vertex_normals(mesh: Mesh) -> Tensor:
    """Smooth unit normals [V,3] float32: face normals weighted by area; +z where a vertex has no area around it."""
    v_pos = mesh.v_pos.double()
    a, b, c = (v_pos[mesh.t_pos_idx[:, corner]] for corner in range(3))
    twice_area = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(v_pos)
    for corner in range(3):
        total.index_add_(0, mesh.t_pos_idx[:, corner], twice_area)
    length = total.norm(dim=1, keepdim=True)
    upwards = total.new_tensor([0.0, 0.0, 1.0])
    return torch.where(length > 0, total / length.clamp(min=torch.finfo(torch.float64).tiny), upwards).float()


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


def _mtl(image: str) -> str:
    """A material that shows the texture as it is: diffuse only (illum 1), no highlight."""
    return f"newmtl textured\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image}\n"


def _write_obj(path: Path, mesh: Mesh, normals: Tensor, mtl: str) -> None:
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    uv = mesh.v_uv.double()
    flipped = torch.stack((uv[:, 0], 1 - uv[:, 1]), dim=1)
    position, corner = mesh.t_pos_idx + 1, mesh.t_uv_idx + 1
    faces = torch.stack((position, corner, position), dim=2).view(-1, 9)
    with atomic_file(path) as file:
        file.write(f"mtllib {mtl}\nusemtl textured\n".encode())
        # Nine digits bring every float32 back exactly; six decimals are 1/500 of a texel at 2048.
        for line, rows in (
            ("v %.9g %.9g %.9g\n", mesh.v_pos.double()),
            ("vt %.7f %.7f\n", flipped),
            ("vn %.4f %.4f %.4f\n", normals.double()),
            ("f %d/%d/%d %d/%d/%d %d/%d/%d\n", faces),
        ):
            for first in range(0, len(rows), LINES_PER_BLOCK):
                block = rows[first : first + LINES_PER_BLOCK]
                file.write((line * len(block) % tuple(block.flatten().tolist())).encode())


# GLB


def _write_glb(path: Path, mesh: Mesh, normals: Tensor, png: bytes, up_axis: str) -> None:
    """glTF 2.0 binary: a header, a JSON chunk and a binary chunk, each padded to four bytes."""
    indices, positions, directions, uv = _split_at_seams(mesh, normals)
    chunks = [indices.tobytes(), positions.tobytes(), directions.tobytes(), uv.tobytes(), png]
    targets = [GLTF_ELEMENT_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, None]
    views, offset = [], 0
    for chunk, target in zip(chunks, targets, strict=True):
        view: dict[str, Any] = {"buffer": 0, "byteOffset": offset, "byteLength": len(chunk)}
        views.append(view | ({"target": target} if target else {}))
        offset += len(chunk) + -len(chunk) % 4
    document = _gltf(indices, positions, views, offset, up_axis)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", offset, b"BIN\0"))
        for chunk in chunks:
            file.write(chunk + b"\0" * (-len(chunk) % 4))


def _gltf(indices: Array, positions: Array, views: list[dict[str, Any]], length: int, up_axis: str) -> dict[str, Any]:
    count = len(positions)
    vector = {"componentType": GLTF_FLOAT, "count": count, "type": "VEC3"}
    index_type = GLTF_UINT16 if indices.dtype == np.uint16 else GLTF_UINT32
    node: dict[str, Any] = {"name": "model", "mesh": 0}
    if up_axis != "+y":
        node["rotation"] = TO_Y_UP[up_axis]
    return {
        "asset": {"version": "2.0", "generator": "advtex"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [
            {
                "name": "model",
                "primitives": [
                    {"attributes": {"POSITION": 1, "NORMAL": 2, "TEXCOORD_0": 3}, "indices": 0, "material": 0}
                ],
            }
        ],
        "materials": [
            {
                "name": "textured",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [
            {
                "magFilter": GLTF_LINEAR,
                "minFilter": GLTF_LINEAR_MIPMAP_LINEAR,
                "wrapS": GLTF_CLAMP,
                "wrapT": GLTF_CLAMP,
            }
        ],
        "images": [{"name": "texture", "bufferView": 4, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": index_type, "count": indices.size, "type": "SCALAR"},
            {"bufferView": 1, **vector, "min": positions.min(0).tolist(), "max": positions.max(0).tolist()},
            {"bufferView": 2, **vector},
            {"bufferView": 3, "componentType": GLTF_FLOAT, "count": count, "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


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
