"""All views as compact types, and the pairs that the loader draws from (paper section 3.3).

Per view and pixel: color 3 bytes, uv 4 bytes (two int16), depth 2 bytes (float16 metres): 9 bytes, 2.8 MB at 640x480.
Views that do not fit on the device stay on the host, and go there one by one (`ViewMaps.only`) or by blocks
(`streaming.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Mesh, View
from advtex_engine.render.filtering import greatest, window_sums
from advtex_engine.render.prefetch import uploaded
from advtex_engine.render.rasterize import rasterize_views
from advtex_engine.render.texture import bilinear_footprint, decode_uv, encode_uv, number_slots, touched_slots

DEPTH_TOLERANCE = {"object": 0.03, "scene": 0.1}  # theta_z, metres (paper section 3.3)
BYTES_PER_PIXEL = 9
TOGETHER = 32  # views of the host that are on the device at once

UNMEASURED = 1 / 50
"""Of an image's width: how far a reading speaks for pixels that have none. Depth cameras measure nothing beside what
stands in front of something else, and depth that is seen from the color camera has gaps there."""
ALWAYS_READ = 1 / 1000
"""Of the pixels inside of surfaces, how many may lack a reading where depth is found of every surface within reach."""
ASKED = 8  # views, of how often a reading lacks
NEIGHBORS = 4  # texels: a surface counts as seen where one so near is, since views from afar skip some

Allocate = Callable[[tuple[int, ...], torch.dtype], Tensor]
"""Shape and type -> a tensor with any content, where views are to be kept."""


@dataclass(frozen=True)
class ViewMaps:
    """What the optimization reads, V views of H x W pixels.

    color: [V,H*W,3] uint8. uv: [V,H*W,2] int16 (texture.encode_uv). depth: [V,H*W] float16 metres along z, rendered
    from the mesh; 0 = background (no mesh, the device's depth contradicts the mesh, or the view's mask leaves it out).
    intrinsics: [V,4] float32 fx, fy, cx, cy in pixels. world_to_camera: [V,4,4] float64.
    slot_map: [texture height, texture width] int32, rows of the compact texture, -1 = sampled by no view.
    Color, uv and depth may lie on the host; all else is on the device that computes.
    """

    color: Tensor
    uv: Tensor
    depth: Tensor
    intrinsics: Tensor
    world_to_camera: Tensor
    slot_map: Tensor
    slots: int
    width: int
    height: int

    @property
    def count(self) -> int:
        return self.color.shape[0]

    @property
    def device(self) -> torch.device:
        """The device that computes; color, uv and depth may lie elsewhere."""
        return self.slot_map.device

    def only(self, view: int) -> ViewMaps:
        """One of the views, on the device; it shares the memory of what is there already."""
        part = slice(view, view + 1)
        return replace(
            self,
            color=self.color[part].to(self.device),
            uv=self.uv[part].to(self.device),
            depth=self.depth[part].to(self.device),
            intrinsics=self.intrinsics[part],
            world_to_camera=self.world_to_camera[part],
        )

    def to(self, device: torch.device) -> ViewMaps:
        """The same maps on another device."""
        return replace(
            self,
            color=self.color.to(device),
            uv=self.uv.to(device),
            depth=self.depth.to(device),
            intrinsics=self.intrinsics.to(device),
            world_to_camera=self.world_to_camera.to(device),
            slot_map=self.slot_map.to(device),
        )


def build_view_maps(atlas: Atlas, views: tuple[View, ...], kind: str, allocate: Allocate | None = None) -> ViewMaps:
    """Rasterizes every view: view-to-texture map, depth and foreground.

    allocate: makes what color, uv and depth are kept in; by default on the mesh's device.

    Device depth masks what the mesh lacks: a pixel whose measured depth differs from the mesh's by more than theta_z
    shows something else than the mesh. So do pixels near it that have no reading (`UNMEASURED`), and all that have none
    where that means that nothing is there (`always_read`), but for those of a surface that no other pixel shows.
    """
    assert views and all(
        (v.camera.width, v.camera.height) == (views[0].camera.width, views[0].camera.height) for v in views
    )
    mesh, device = atlas.mesh, atlas.mesh.v_pos.device
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    width, height, tolerance = views[0].camera.width, views[0].camera.height, DEPTH_TOLERANCE[kind]
    allocate = allocate or (lambda shape, dtype: torch.empty(shape, dtype=dtype, device=device))
    count, pixels = len(views), width * height
    color = allocate((count, pixels, 3), torch.uint8)
    uv = allocate((count, pixels, 2), torch.int16)
    depth = allocate((count, pixels), torch.float16)
    touched = torch.zeros((atlas.height, atlas.width), dtype=torch.bool, device=device)
    rasterized = rasterize_views(mesh, [view.camera for view in views])
    nothing_there = always_read(mesh, views, tolerance)
    there = uploaded(views, device, with_color=color.device == device)
    for index, (view, fragments) in enumerate(zip(there, rasterized, strict=True)):
        hit = fragments.face_index >= 0
        if view.mask is not None:
            hit = hit & view.mask
        shown = fragments.depth
        if view.depth is not None:
            differs, doubtful = contradicted(view.depth, fragments.depth, tolerance)
            if nothing_there:
                doubtful = view.depth == 0
            hit = hit & ~differs
            shown = torch.where(doubtful, -shown, shown)
        corners = mesh.v_uv[mesh.t_uv_idx[fragments.face_index.clamp(min=0).long()]]
        color[index] = view.color.view(-1, 3)
        uv[index] = encode_uv((corners * fragments.barycentric[..., None]).sum(2)).view(-1, 2)
        depth[index] = torch.where(hit, shown, 0.0).flatten()
        if index % TOGETHER == TOGETHER - 1 or index == count - 1:
            newest = slice(index - index % TOGETHER, index + 1)
            codes, seen = uv[newest].to(device), depth[newest].to(device) > 0
            touched |= touched_slots(codes[:, None], seen[:, None], atlas.width, atlas.height)[0] >= 0
    touched |= _give_doubtful(uv, depth, touched)
    slot_map, slots = number_slots(touched)
    K = torch.stack([view.camera.K for view in views])
    return ViewMaps(
        color=color,
        uv=uv,
        depth=depth,
        intrinsics=torch.stack((K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]), 1).to(device, torch.float32),
        world_to_camera=torch.stack([view.camera.world_to_camera for view in views]).to(device, torch.float64),
        slot_map=slot_map,
        slots=slots,
        width=width,
        height=height,
    )


def always_read(mesh: Mesh, views: Sequence[View], tolerance: float) -> bool:
    """Whether the views' depth has a reading wherever it looks at the mesh, away from where that ends or jumps: as the
    dense depth of phones has, and rendered one, of all that is near enough. What has none then shows what lies behind.

    tolerance: metres between the nearest and farthest depth of what is no jump.
    """
    measured = [view for view in views if view.depth is not None]
    asked = measured[:: -(-len(measured) // ASKED) or 1]
    inside, lacking = 0, 0
    for view, fragments in zip(asked, rasterize_views(mesh, [view.camera for view in asked]), strict=True):
        assert view.depth is not None
        rendered = torch.where(fragments.face_index >= 0, fragments.depth, 0.0)
        reach = round(UNMEASURED * rendered.shape[1])
        nearest, farthest = -greatest(-rendered, reach), greatest(rendered, reach)
        surface = (nearest > 0) & (farthest - nearest < tolerance)
        if view.mask is not None:
            surface = surface & view.mask.to(surface.device)
        inside += int(surface.sum())
        lacking += int((surface & (view.depth == 0).to(surface.device)).sum())
    return lacking < ALWAYS_READ * inside


def contradicted(measured: Tensor, rendered: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """[H,W] bool: pixels whose measured depth differs from the mesh's by the tolerance or more, and those without a
    reading that have such a pixel near them (`UNMEASURED`).

    measured: [H,W] metres along z, 0 = no reading. rendered: the same of the mesh, 0 = nothing hit.
    """
    read = measured > 0
    differs = read & ((measured - rendered).abs() >= tolerance)
    near = window_sums(differs[None].to(torch.int16), round(UNMEASURED * measured.shape[1]))[0] > 0
    return differs, near & ~read


def _give_doubtful(uv: Tensor, depth: Tensor, touched: Tensor) -> Tensor:
    """Makes pixels whose depth is negative background, or foreground where they show what no other pixel does.

    uv, depth: of `ViewMaps`; depth is changed. touched: [H,W] bool, texels that the other pixels show. -> [H,W] bool,
    texels that are shown besides.
    """
    height, width = touched.shape
    size = torch.tensor([width, height], dtype=torch.float32, device=touched.device)
    besides = torch.zeros_like(touched)
    near: Tensor | None = None
    for codes, stored in zip(uv, depth, strict=True):
        doubtful = stored < 0
        if not bool(doubtful.any()):
            continue
        if near is None:
            near = window_sums(touched[None].to(torch.int16), NEIGHBORS)[0] > 0
        place = decode_uv(codes[doubtful].to(touched.device)) * size
        column, row = place.long().unbind(1)
        only = ~near[row.clamp(max=height - 1), column.clamp(max=width - 1)]
        stored[doubtful] = torch.where(only.to(stored.device), -stored[doubtful], 0.0)
        texels, weights = bilinear_footprint(place[only], width, height)
        besides.view(-1)[texels[weights > 0]] = True
    return besides


def foregrounds(maps: ViewMaps) -> Tensor:
    """[V] bool, which views see anything of the mesh."""
    return torch.stack([(depth > 0).any() for depth in maps.depth]).to(maps.device)


def held_bytes(maps: Iterable[ViewMaps], device: torch.device) -> int:
    """Bytes of the view maps that lie on the device."""
    tensors = (getattr(level, name) for level in maps for name in ("color", "uv", "depth", "slot_map"))
    return sum(tensor.nbytes for tensor in tensors if tensor.device == device)
