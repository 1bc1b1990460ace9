"""Camera refinement: poses and exposures that make the photographs agree on the surface (Zhou & Koltun 2014).

Held-out views stay as they are, so the gauge is kept: content stays, on average over all that the cameras see, where
the given cameras put it. Nothing is taken on trust: points that were set aside say per view whether its new pose is
better than the given one, which it gets back if not, and whether all of it is better than nothing. The same goes for
the exposures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.cameras import stack_cameras
from advtex_engine.refine_check import better, disagreement, improved
from advtex_engine.refine_exposure import corrected_color, fit_exposure, sample_colors
from advtex_engine.refine_points import Observations, draw_candidates, observe, order_of_preference, surface_depths
from advtex_engine.refine_pose import local_contrast, look, refine_poses
from advtex_engine.scene import Mesh, Scene

WORKING_WIDTH = 320  # pixels; finer images take longer and gain little
POINTS_PER_VIEW = 5000
CHECKED_SHARE = 0.15  # of the points are set aside to judge the result
CHECKED_PER_VIEW = 1500
SPREAD_STRIDE = 16  # every so many of the points hold the content in place
MIN_CANDIDATES = 1000  # points of the drawn ones that two views must see, to refine anything
CONTRAST_SCALE, COLOR_SCALE = 0.5, 0.1  # disagreements beyond twice that are occlusions or highlights
LUMINANCE = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class Refinement:
    """What refinement found for V training views, and the report about it.

    world_to_camera: [V,4,4] float64. gain, offset: [V,3] float32, corrected color = gain * color + offset in [0,1].
    """

    world_to_camera: Tensor
    gain: Tensor
    offset: Tensor
    report: dict[str, Any]


def refinement_to_dict(refinement: Refinement) -> dict[str, Any]:
    """Tensors and plain values; `refinement_from_dict` is its inverse."""
    return dict(vars(refinement))


def refinement_from_dict(saved: Mapping[str, Any]) -> Refinement:
    """Inverse of `refinement_to_dict`; other keys are ignored."""
    return Refinement(**{key: saved[key] for key in Refinement.__dataclass_fields__})


@dataclass(frozen=True)
class _Sight:
    """Images at the working size, their cameras, and the points to fit, to hold on to, and to check.

    color: [V,3,h,w] float32 in [0,1]. features: `local_contrast` at full resolution. K, given: float64.
    """

    color: Tensor
    features: Tensor
    K: Tensor
    given: Tensor
    fitted: Observations
    spread: Observations
    checked: Observations

    @property
    def size(self) -> tuple[int, int]:
        return self.color.shape[3], self.color.shape[2]


def refine_cameras(scene: Scene, device: torch.device, seed: int) -> Refinement:
    """Poses and exposures of the training views from their own photographs and the mesh; held-out views are not read.

    On a CPU the same input and seed give the same result. Views that share too little with others keep their pose.
    """
    sight = _look_at(scene, device, seed)
    if sight is None:
        return _unmoved(scene)
    found, poses = _poses(sight)
    gain, offset, exposures = _exposures(sight, found)
    scale = scene.views[0].camera.width / sight.size[0]
    motion = _motion(found, sight.given, sight.K, sight.fitted) * torch.tensor([1000.0, 1.0, scale])
    columns = {**poses, **exposures, "gain": gain, "offset": offset}
    columns |= {key: motion[:, row] for row, key in enumerate(("moved_mm", "turned_degrees", "moved_pixels"))}
    frames = [
        {"name": view.name, **{key: _plain(values[row]) for key, values in columns.items()}}
        for row, view in enumerate(scene.views)
    ]
    totals = {key: _plain(columns[key].double().nanmean()) for key in columns if columns[key].ndim == 1}
    return Refinement(found.cpu(), gain.cpu(), offset.cpu(), {"mean": totals, "frames": frames})


def apply_refinement(scene: Scene, refinement: Refinement) -> Scene:
    """The scene with its training views' cameras moved and their colors corrected; held-out views as they are."""
    views = []
    for view, pose, gain, offset in zip(
        scene.views, refinement.world_to_camera, refinement.gain, refinement.offset, strict=True
    ):
        color = corrected_color(view.color.to(torch.float32) / 255, gain, offset)
        camera = replace(view.camera, world_to_camera=pose)
        views.append(replace(view, camera=camera, color=(color * 255).round().to(torch.uint8)))
    return replace(scene, views=tuple(views))


def _unmoved(scene: Scene) -> Refinement:
    """Nothing to go by: everything as it came."""
    given = torch.stack([view.camera.world_to_camera for view in scene.views]).double()
    ones = torch.ones((len(given), 3))
    return Refinement(given, ones, torch.zeros_like(ones), {"mean": {}, "frames": []})


def _look_at(scene: Scene, device: torch.device, seed: int) -> _Sight | None:
    """None when hardly anything is seen by two views."""
    generator = torch.Generator().manual_seed(seed)
    mesh = Mesh(scene.mesh.v_pos.to(device), scene.mesh.t_pos_idx.to(device))
    camera = scene.views[0].camera
    width = min(WORKING_WIDTH, camera.width)
    size = (width, max(1, round(camera.height * width / camera.width)))
    color = torch.cat([_shrunk(view.color.to(device), size) for view in scene.views])
    features = local_contrast(_luminance(color), 1)
    cameras, depths = surface_depths(mesh, scene.views, size, scene.kind)
    K, given = stack_cameras(cameras, device)
    candidates = draw_candidates(mesh, cameras, depths, features[:, 1:].norm(dim=1), generator)
    if len(candidates.position) < MIN_CANDIDATES:
        return None
    order = order_of_preference(candidates, generator)
    aside = round(CHECKED_SHARE * len(order))
    checked = observe(candidates, order[:aside], cameras, depths, CHECKED_PER_VIEW)
    fitted = observe(candidates, order[aside:], cameras, depths, POINTS_PER_VIEW)
    few = torch.arange(0, len(order), SPREAD_STRIDE, device=order.device)
    spread = observe(candidates, few, cameras, depths, POINTS_PER_VIEW // 4)
    return _Sight(color, features, K, given, fitted, spread, checked)


def _poses(sight: _Sight) -> tuple[Tensor, dict[str, Tensor]]:
    """Poses [V,4,4] that the checked points approve of, and columns [V] for the report."""
    given, checked = sight.given, sight.checked
    found = refine_poses(_luminance(sight.color), sight.K, given, sight.fitted, sight.spread)
    before = look(sight.features, sight.K, given, checked, sight.size)
    after = look(sight.features, sight.K, found, checked, sight.size)
    good = improved(
        before.value[..., None], after.value[..., None], before.valid & after.valid, checked, CONTRAST_SCALE
    )
    found = torch.where(good[:, None, None], found, given)
    after = look(sight.features, sight.K, found, checked, sight.size)
    old = disagreement(before.value[..., None], before.valid, checked, CONTRAST_SCALE)
    new = disagreement(after.value[..., None], after.valid, checked, CONTRAST_SCALE)
    if not better(new, old):
        found, good, new = given, torch.zeros_like(good), old
    return found, {"residual_before": old, "residual_after": new, "kept_pose": ~good}


def _exposures(sight: _Sight, world_to_camera: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Gain and offset [V,3] that the checked points approve of, and columns [V] for the report."""
    checked = sight.checked
    fit = look(sight.features, sight.K, world_to_camera, sight.fitted, sight.size)
    gain, offset = fit_exposure(sample_colors(sight.color, fit.pixel), fit.valid, sight.fitted)
    seen = look(sight.features, sight.K, world_to_camera, checked, sight.size)
    raw = sample_colors(sight.color, seen.pixel)
    good = improved(raw, corrected_color(raw, gain[:, None], offset[:, None]), seen.valid, checked, COLOR_SCALE)[
        :, None
    ]
    gain, offset = torch.where(good, gain, 1.0), torch.where(good, offset, 0.0)
    old = disagreement(raw, seen.valid, checked, COLOR_SCALE)
    new = disagreement(corrected_color(raw, gain[:, None], offset[:, None]), seen.valid, checked, COLOR_SCALE)
    if not better(new, old):
        gain, offset, new, good = torch.ones_like(gain), torch.zeros_like(offset), old, torch.zeros_like(good)
    return gain, offset, {"color_before": old, "color_after": new, "kept_exposure": ~good[:, 0]}


def _motion(found: Tensor, given: Tensor, K: Tensor, points: Observations) -> Tensor:
    """[V,3] float64 on the CPU: metres and degrees that each camera moved, and median pixels that its content did."""
    change = found @ torch.linalg.inv(given)
    centers = [-(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0] for pose in (found, given)]
    # The angle's sine and cosine, since a small angle's cosine alone has lost it.
    rotation = change[:, :3, :3]
    skew = rotation - rotation.mT
    sine = 0.5 * torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), 1).norm(dim=1)
    cosine = 0.5 * (rotation.diagonal(dim1=1, dim2=2).sum(1) - 1)
    world = points.position[points.point]
    pixels = []
    for pose in (found, given):
        homogeneous = (world @ pose[:, :3, :3].mT + pose[:, None, :3, 3]) @ K.mT
        pixels.append(homogeneous[..., :2] / homogeneous[..., 2:])
    shift = torch.where(points.seen, (pixels[0] - pixels[1]).norm(dim=-1), torch.nan).nanmedian(1).values
    metres = (centers[0] - centers[1]).norm(dim=1)
    return torch.stack((metres, torch.atan2(sine, cosine).rad2deg(), shift), 1).cpu()


def _luminance(color: Tensor) -> Tensor:
    """[V,3,h,w] -> [V,h,w]."""
    return (color * color.new_tensor(LUMINANCE)[:, None, None]).sum(1)


def _shrunk(color: Tensor, size: tuple[int, int]) -> Tensor:
    """[H,W,3] uint8 -> [1,3,h,w] float32 in [0,1], averaged over areas."""
    image = color.permute(2, 0, 1)[None].to(torch.float32) / 255
    return F.interpolate(image, (size[1], size[0]), mode="area")


def _plain(value: Tensor) -> Any:
    """A bool, a number of four decimals (None for nan), or a list of them."""
    if value.ndim:
        return [_plain(part) for part in value]
    if value.dtype == torch.bool:
        return bool(value)
    return None if bool(value.isnan()) else round(float(value), 4)
