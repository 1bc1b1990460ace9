"""The textured model as USDZ, which iOS shows in AR Quick Look.

A stored zip, its entries aligned to 64 bytes: a binary crate, then the images. Metres, Y up; a mesh and a
UsdPreviewSurface for each page of the atlas. USD counts v from the image's bottom row.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt
from torch import Tensor

from advtex_engine.core.errors import EngineError
from advtex_engine.core.scene import TO_Y_UP
from advtex_engine.results.images import encode_texture, shrunk
from advtex_engine.results.pages import Page, split_at_seams
from advtex_engine.runtime.files import write_atomically

MAX_SIDE = 4096
"""Texels: larger images are not shown on iOS."""


def write_usdz(path: Path, pages: Sequence[Page], normals: Tensor, up_axis: str, *, lossless: bool) -> None:
    """Write the pages' faces with their images, made smaller to MAX_SIDE where they are larger.

    normals: [V,3] of the pages' vertices. lossless: the images are PNGs instead of JPEGs.
    """
    with tempfile.TemporaryDirectory(prefix="advtex-usdz-") as folder:
        crate, package = Path(folder, f"{path.stem}.usdc"), Path(folder, path.name)
        stage = Usd.Stage.CreateNew(str(crate))
        _describe(stage, up_axis)
        for page in pages:
            image = _write_image(Path(folder, f"texture{page.suffix}"), page.image, lossless)
            mesh = _add_mesh(stage, f"/model/page{page.suffix}", page, normals)
            material = _add_material(stage, f"/model/{page.material}", image)
            if page.normal_map is not None:
                relief = _write_image(Path(folder, f"normals{page.suffix}"), page.normal_map, lossless)
                _add_normal_map(stage, f"/model/{page.material}", relief)
            UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
        stage.GetRootLayer().Save()
        if not UsdUtils.CreateNewARKitUsdzPackage(Sdf.AssetPath(str(crate)), str(package)):
            raise EngineError(f"{path}: usd-core could not put the model together; leave the format out")
        write_atomically(path, package.read_bytes())


def _write_image(path: Path, texels: Tensor, lossless: bool) -> str:
    """Its name, with the suffix of its kind."""
    image = encode_texture(shrunk(texels, MAX_SIDE), lossless=lossless)
    path = path.with_name(f"{path.name}.{image.suffix}")
    path.write_bytes(image.data)
    return path.name


def _describe(stage: Usd.Stage, up_axis: str) -> None:
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/model")
    x, y, z, w = TO_Y_UP[up_axis]
    root.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
    Usd.ModelAPI(root).SetKind("component")
    stage.SetDefaultPrim(root.GetPrim())


def _add_mesh(stage: Usd.Stage, path: str, page: Page, normals: Tensor) -> UsdGeom.Mesh:
    indices, positions, of_vertex, uv = split_at_seams(page.mesh, normals)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(positions))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([positions.min(axis=0), positions.max(axis=0)])))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(indices.size // 3, 3, np.int32)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(of_vertex))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)))
    return mesh


def _add_material(stage: Usd.Stage, path: str, image: str) -> UsdShade.Material:
    """A rough surface of the image's color, without highlights."""
    material = UsdShade.Material.Define(stage, path)
    reader = _add_shader(stage, f"{path}/st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    texture = _add_texture(stage, path, "texture", image, "sRGB")
    surface = _add_shader(stage, f"{path}/surface", "UsdPreviewSurface")
    color = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    shaded = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(shaded)
    return material


def _add_normal_map(stage: Usd.Stage, path: str, image: str) -> None:
    """To the material at `path`; from 0 to 1 it has what counts from -1 to 1."""
    texture = _add_texture(stage, path, "normals", image, "raw")
    texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    texture.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    vectors = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface = UsdShade.Shader.Get(stage, f"{path}/surface")
    surface.CreateInput("normal", Sdf.ValueTypeNames.Normal3f).ConnectToSource(vectors)


def _add_texture(stage: Usd.Stage, path: str, name: str, image: str, color_space: str) -> UsdShade.Shader:
    """The image at the coordinates of the material's reader `st`."""
    texture = _add_shader(stage, f"{path}/{name}", "UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{image}"))
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(color_space)
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("clamp")
    coordinates = UsdShade.Shader.Get(stage, f"{path}/st").GetOutput("result")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    return texture


def _add_shader(stage: Usd.Stage, path: str, kind: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader
