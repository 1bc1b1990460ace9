"""The textured model as files: OBJ + MTL + PNG, GLB, and USDZ.

OBJ keeps the scan's world coordinates; its v counts from the image's bottom row, so v is flipped here, once.
glTF is +Y up: the GLB's node turns the scan's up axis there and leaves the vertices as they are; its uv has the
same origin as ours. All carry smooth normals, and one material and sRGB image for each page of the atlas: the OBJ a
PNG, the GLB and the USDZ (`usdz.py`) a JPEG unless they are asked for a PNG.

A normal map lies beside the texture, for viewers that light the model; none is needed for the texture, which has the
light of the place in it. No tangents are written: viewers make them of the uv, of each vertex as MikkTSpace does or of
each pixel, and on a relief with 78 charts the second way is .04 degrees worse than the first, of which the map was
baked, where the map takes the error from 11.4 degrees to 1.4. They would cost 16 bytes a vertex.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from advtex_engine.core.scene import TO_Y_UP, Atlas
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.results.images import JPEG_QUALITY, encode_png, encode_texture
from advtex_engine.results.pages import Array, Page, on_cpu, split_at_seams, split_pages
from advtex_engine.results.usdz import write_usdz
from advtex_engine.runtime.files import atomic_file, write_atomically

LINES_PER_BLOCK = 1 << 16
"""OBJ lines formatted at once: bounds the memory of an export."""
GLTF_FLOAT, GLTF_UINT16, GLTF_UINT32 = 5126, 5123, 5125
GLTF_ARRAY_BUFFER, GLTF_ELEMENT_ARRAY_BUFFER = 34962, 34963
GLTF_LINEAR, GLTF_LINEAR_MIPMAP_LINEAR, GLTF_CLAMP = 9729, 9987, 33071


def export_model(
    out: Path,
    atlas: Atlas,
    texture: Tensor,
    *,
    up_axis: str,
    lossless: bool = False,
    usdz: bool = False,
    normal_map: Tensor | None = None,
    name: str = "model",
) -> tuple[Path, ...]:
    """Write `name`.obj, .mtl, .png, .glb and with `usdz` .usdz into the folder `out`; returns their paths.

    texture: [atlas.height,atlas.width,3] uint8 sRGB, or float in [0,1] (clamped). Pages after the first are
    `name`_2.png and so on; a page without faces is left out. lossless: GLB and USDZ carry PNGs as well. normal_map: of
    `normal_map.bake_normals`, in all of them; the OBJ's is `name`_normal.png. Each file is whole or absent; the OBJ
    comes after the files that it names.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    assert up_axis in TO_Y_UP
    out.mkdir(parents=True, exist_ok=True)
    normals = vertex_normals(on_cpu(atlas.mesh))
    pages = split_pages(atlas, texture, normal_map)
    obj, mtl, glb, package = (out / f"{name}.{suffix}" for suffix in ("obj", "mtl", "glb", "usdz"))
    images = [out / f"{name}{page.suffix}.png" for page in pages]
    for image, page in zip(images, pages, strict=True):
        write_atomically(image, encode_png(page.image))
    reliefs = dict[str, Path]()
    for page in pages:
        if page.normal_map is not None:
            reliefs[page.suffix] = out / f"{name}_normal{page.suffix}.png"
            write_atomically(reliefs[page.suffix], encode_png(page.normal_map))
    materials = (_mtl(page, image, reliefs.get(page.suffix)) for page, image in zip(pages, images, strict=True))
    write_atomically(mtl, "\n".join(materials).encode())
    _write_obj(obj, pages, normals, mtl.name)
    _write_glb(glb, pages, normals, up_axis, lossless)
    if usdz:
        write_usdz(package, pages, normals, up_axis, lossless=lossless)
    return obj, mtl, *images, *reliefs.values(), glb, *([package] if usdz else ())


def write_glb(
    path: Path,
    atlas: Atlas,
    texture: Tensor,
    *,
    up_axis: str,
    quality: int = JPEG_QUALITY,
    normal_map: Tensor | None = None,
) -> None:
    """The GLB alone, its images JPEGs; `export_model` describes the rest."""
    pages = split_pages(atlas, texture, normal_map)
    write_pages(path, pages, vertex_normals(on_cpu(atlas.mesh)), up_axis, quality)


def write_pages(path: Path, pages: Sequence[Page], normals: Tensor, up_axis: str, quality: int = JPEG_QUALITY) -> None:
    """The GLB of these pages. normals: [V,3] of their vertices."""
    _write_glb(path, pages, normals, up_axis, False, quality)


# OBJ


def _mtl(page: Page, image: Path, relief: Path | None) -> str:
    """A material that shows the texture as it is: diffuse only (illum 1), no highlight.

    `norm` is the word of MTL's extension for physically based materials: a normal map under `map_Bump` would be taken
    for heights by those who go by the book.
    """
    norm = "" if relief is None else f"norm {relief.name}\n"
    return f"newmtl {page.material}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image.name}\n{norm}"


def _write_obj(path: Path, pages: Sequence[Page], normals: Tensor, mtl: str) -> None:
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


def _write_glb(
    path: Path,
    pages: Sequence[Page],
    normals: Tensor,
    up_axis: str,
    lossless: bool,
    quality: int = JPEG_QUALITY,
) -> None:
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
        arrays = split_at_seams(page.mesh, normals)
        targets = (GLTF_ELEMENT_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER, GLTF_ARRAY_BUFFER)
        views = [add_view(array.tobytes(), target) for array, target in zip(arrays, targets, strict=True)]
        _add_page(document, page, arrays, views)
        named = [(f"texture{page.suffix}", page.image)]
        if page.normal_map is not None:
            document["materials"][-1]["normalTexture"] = {"index": len(document["textures"]) + 1}
            named.append((f"normals{page.suffix}", page.normal_map))
        for image_name, texels in named:
            image = encode_texture(texels, lossless=lossless, quality=quality)
            view = {"bufferView": add_view(image.data, None), "mimeType": image.media_type}
            document["textures"].append({"source": len(document["images"]), "sampler": 0})
            document["images"].append({"name": image_name, **view})
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


def _add_page(document: dict[str, Any], page: Page, arrays: tuple[Array, ...], views: Sequence[int]) -> None:
    """A primitive with its material, which shows the texture that comes next.

    arrays: of `split_at_seams`, in the buffer views `views`.
    """
    indices, positions = arrays[:2]
    first, number = len(document["accessors"]), len(document["materials"])
    texture = {"index": len(document["textures"])}
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
    shading = {"baseColorTexture": texture, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    document["materials"].append({"name": page.material, "pbrMetallicRoughness": shading, "doubleSided": True})
