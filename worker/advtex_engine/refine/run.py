"""Camera refinement: poses and exposures that make the photographs agree on the surface (Zhou & Koltun 2014).

The poses of held-out views stay as they are, so the gauge is kept: content stays, on average over all that the cameras
see, where the given cameras put it. Nothing is taken on trust: cells of the surface that were set aside say per view
whether its new pose is better than the given one, which it gets back if not, and whether all of it is better than
nothing. The same goes for the exposures.

What is grossly wrong is put right first. Photographs that are off by tens of pixels have nothing to say to each other,
but a depth image finds its way to the mesh (`registration`): such poses are where the rest begins.

Then what all frames share is corrected if it is grossly wrong: a lens that bends lines (`distortion`), intrinsics, and
the color camera's place on the device. Held-out frames, which the same device has taken, get that correction too. What
is off by less stays as given, since the poses make up for it and nothing else needs to know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera, DepthFrame, Mesh, Scene, View
from advtex_engine.ingest.depth import depth_in_color_image
from advtex_engine.mesh.registration import register_camera
from advtex_engine.refine.check import better, disagreement, improved
from advtex_engine.refine.distortion import refine_distortion, straightened
from advtex_engine.refine.exposure import corrected_color, fit_exposure, sample_colors
from advtex_engine.refine.geometry import refine_geometry
from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import keep_gauge, refine_poses, sample_points
from advtex_engine.refine.rig import Device, refine_device
from advtex_engine.refine.working_views import CONTRAST_SCALE, WorkingViews, motion, working_views
from advtex_engine.runtime.available_memory import give_back_unused
from advtex_engine.runtime.threads import in_threads, one_thread_each

COLOR_SCALE = 0.1  # disagreements beyond twice that are highlights
ROUNDS = 2  # of geometry
DEVICE_POINTS = 1250  # per view
DEVICE_MARGIN = 0.9  # of the disagreement may be left for a correction of the device to be taken


@dataclass(frozen=True)
class Refinement:
    """What refinement found for V training views, and the report about it.

    world_to_camera: [V,4,4] float64. gain, offset: [V,3] float32, corrected color = gain * color + offset in [0,1].
    lens [3,3] and device_offset [4,4]: the `Device` that all frames share, at their full size; None if as given. The
    poses of training views hold the offset already. distortion: [2] float32, the lens's k1 and k2; None if the
    photographs are a pinhole's. v_pos: [M,3] float32, the mesh's vertices; None if as given.
    """

    world_to_camera: Tensor
    gain: Tensor
    offset: Tensor
    report: dict[str, Any]
    lens: Tensor | None = None
    device_offset: Tensor | None = None
    distortion: Tensor | None = None
    v_pos: Tensor | None = None


def refinement_to_dict(refinement: Refinement) -> dict[str, Any]:
    """Tensors and plain values; `refinement_from_dict` is its inverse."""
    return dict(vars(refinement))


def refinement_from_dict(saved: Mapping[str, Any]) -> Refinement:
    """Inverse of `refinement_to_dict`; other keys are ignored."""
    return Refinement(**{key: saved[key] for key in Refinement.__dataclass_fields__ if key in saved})


def refine_scene(scene: Scene, device: torch.device, seed: int) -> Refinement:
    """Cameras and exposures, and then the geometry; where that has moved, poses and geometry once more: each was found
    beside what was wrong with the other.

    The report tells of the first cameras, and of the geometry round by round.
    """
    refinement = refine_cameras(scene, device, seed)
    rounds = list[dict[str, Any]]()
    alone = False
    while len(rounds) < ROUNDS:
        refined = apply_refinement(scene, refinement)
        if rounds:
            again = refine_cameras(refined, device, seed, shared=False)
            refinement = replace(refinement, world_to_camera=again.world_to_camera)
            refined = apply_refinement(scene, refinement)
        give_back_unused()  # what cameras took, before geometry takes as much
        geometry = refine_geometry(refined, device, seed, alone)
        alone = geometry.alone
        rounds.append(geometry.report)
        if geometry.v_pos is None:
            break
        refinement = replace(refinement, v_pos=geometry.v_pos)
    return replace(refinement, report={**refinement.report, "geometry": rounds})


def refine_cameras(scene: Scene, device: torch.device, seed: int, shared: bool = True) -> Refinement:
    """Poses, exposures and what all frames share, from the training views' photographs and the mesh.

    shared: a lens and a device that are grossly wrong are corrected first. Held-out views are not read. On a CPU the
    same input and seed give the same result. Views that share too little with others keep their pose.
    """
    came = scene
    scene, by_depth = _registered(scene, device)
    given = torch.stack([view.camera.world_to_camera for view in came.views]).to(device, torch.float64)
    placed = _placed(scene, given, device, seed)
    if placed is None:
        return _unmoved(came)
    camera, size = scene.views[0].camera, placed.working.size
    scale = (camera.width / size[0], camera.height / size[1])
    distortion, common = None, None
    described = dict[str, Any]()
    if shared:
        distortion, described["distortion"] = refine_distortion(placed.working, placed.poses)
        if distortion is not None:
            placed = _placed(replace(scene, views=_straightened(scene.views, distortion)), given, device, seed)
            if placed is None:
                return _unmoved(came)
        common, described["device"] = _device(placed.working)
        if common is not None:
            full = common.at_scale(*scale)
            views = tuple(_on_device(view, full) for view in placed.scene.views)
            moved_scene, by_then = replace(scene, views=views), common.offset.to(given) @ given
            other = _placed(moved_scene, by_then, device, seed, placed.working)
            if other is not None and _agrees_better(other, placed, common):
                placed, common = other, full
                described["device"] |= _describe(full, views[0].camera)
            else:
                common, described["device"]["corrected"] = None, False
    scene, working, given, found = placed.scene, placed.working, placed.given, placed.poses
    gain, offset, exposures = _exposures(working, found)
    moved = motion(found, replace(working, given=given)) * torch.tensor([1.0, 1.0, scale[0]])
    columns = {**placed.columns, "by_depth": by_depth, **exposures, "gain": gain, "offset": offset}
    columns |= {key: moved[:, row] for row, key in enumerate(("moved_mm", "turned_degrees", "moved_pixels"))}
    frames = [
        {"name": view.name, **{key: _plain(values[row]) for key, values in columns.items()}}
        for row, view in enumerate(scene.views)
    ]
    common_motion = motion(found, replace(working, given=keep_gauge(found, working.given, working.fitted)))
    totals = {key: _plain(columns[key].double().nanmean()) for key in columns if columns[key].ndim == 1}
    totals["common_pixels"] = _plain(common_motion[:, 2].nanmean() * scale[0])
    report = {**described, "mean": totals, "frames": frames}
    lens, place = (None, None) if common is None else (common.lens.cpu(), common.offset.cpu())
    return Refinement(found.cpu(), gain.cpu(), offset.cpu(), report, lens, place, distortion)


def apply_refinement(scene: Scene, refinement: Refinement) -> Scene:
    """The scene with its training views' cameras moved, their colors corrected, and its vertices moved.

    Held-out views are as they came but for corrections of the lens and the device.
    """
    given, heldout = scene.views, scene.heldout
    if refinement.distortion is not None:
        given, heldout = (_straightened(part, refinement.distortion) for part in (given, heldout))
    if refinement.lens is not None and refinement.device_offset is not None:
        common = Device(refinement.lens, refinement.device_offset)
        given, heldout = (tuple(_on_device(view, common) for view in part) for part in (given, heldout))

    def refined(one: tuple[View, Tensor, Tensor, Tensor]) -> View:
        view, pose, gain, offset = one
        color = corrected_color(view.color.to(torch.float32) / 255, gain, offset)
        camera = replace(view.camera, world_to_camera=pose)
        return replace(view, camera=camera, color=(color * 255).round().to(torch.uint8))

    found = (refinement.world_to_camera, refinement.gain, refinement.offset)
    with one_thread_each():
        views = tuple(in_threads(refined, zip(given, *found, strict=True)))
    mesh = scene.mesh if refinement.v_pos is None else replace(scene.mesh, v_pos=refinement.v_pos)
    return replace(scene, mesh=mesh, views=views, heldout=heldout)


def _unmoved(scene: Scene) -> Refinement:
    """Nothing to go by: everything as it came."""
    given = torch.stack([view.camera.world_to_camera for view in scene.views]).double()
    ones = torch.ones((len(given), 3))
    uncorrected = {"distortion": {"corrected": False}, "device": {"corrected": False}}
    return Refinement(given, ones, torch.zeros_like(ones), {**uncorrected, "mean": {}, "frames": []})


def _straightened(views: tuple[View, ...], distortion: Tensor) -> tuple[View, ...]:
    with one_thread_each():
        return tuple(in_threads(lambda view: straightened(view, distortion), views))


def _on_device(view: View, common: Device) -> View:
    """The view with its color camera corrected; its depth's readings stay where they are in the world."""
    old = view.camera
    lens, offset = common.lens.to(old.K), common.offset.to(old.world_to_camera)
    camera = Camera(lens @ old.K, offset @ old.world_to_camera, old.width, old.height)
    depth = None if view.depth is None else depth_in_color_image(view.depth, old, camera)
    return replace(view, camera=camera, depth=depth)


def _device(working: WorkingViews) -> tuple[Device | None, dict[str, Any]]:
    """A correction that the checked points clearly approve of, at the working size, and the report about it."""
    fitted, checked = working.fitted, working.checked
    few = Observations(fitted.position, fitted.point[:, :DEVICE_POINTS], fitted.seen[:, :DEVICE_POINTS])
    found = refine_device(working.contrast, working.size, working.K, working.given, few)
    before = sample_points(working.features, working.K, working.given, checked, working.size)
    after = sample_points(working.features, found.lens @ working.K, found.offset @ working.given, checked, working.size)
    both = before.valid & after.valid
    values = before.value[..., None], after.value[..., None]
    old, new = (disagreement(value, both, checked, CONTRAST_SCALE).nanmean() for value in values)
    taken = bool(new < DEVICE_MARGIN * old) and better(*values, both, checked, working.checked_cell, CONTRAST_SCALE)
    report = {"corrected": taken, "residual_before": _plain(old), "residual_after": _plain(new)}
    return (found if taken else None), report


def _describe(common: Device, camera: Camera) -> dict[str, Any]:
    """The corrected intrinsics of the first view, and by how much the color camera was moved and turned."""
    K, offset = camera.K, common.offset.cpu()
    cosine = 0.5 * (offset[:3, :3].trace() - 1)
    return {
        **{
            key: round(float(K[place]), 2)
            for key, place in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2)))
        },
        "offset_mm": [round(1000 * float(part), 2) for part in offset[:3, 3]],
        "turned_degrees": _plain(cosine.clamp(max=1).acos().rad2deg()),
    }


def _registered(scene: Scene, device: torch.device) -> tuple[Scene, Tensor]:
    """The scene with grossly wrong cameras where their depth fits the mesh; and which these are, [V] bool."""
    mesh = Mesh(scene.mesh.v_pos.to(device), scene.mesh.t_pos_idx.to(device))

    def registered(view: View) -> View:
        if view.depth is None:
            return view
        pose = register_camera(mesh, DepthFrame(view.camera, view.depth.to(device)))
        return view if pose is None else replace(view, camera=replace(view.camera, world_to_camera=pose))

    workers = torch.get_num_threads() if device.type == "cpu" else 1
    views = tuple(in_threads(registered, scene.views, workers))
    moved = [new is not old for new, old in zip(views, scene.views, strict=True)]
    return replace(scene, views=views), torch.tensor(moved)


@dataclass(frozen=True)
class _Placed:
    """A scene and the poses [V,4,4] that were found for it, beginning at `given`; columns [V] for the report."""

    scene: Scene
    working: WorkingViews
    given: Tensor
    poses: Tensor
    columns: dict[str, Tensor]


def _placed(
    scene: Scene, given: Tensor, device: torch.device, seed: int, like: WorkingViews | None = None
) -> _Placed | None:
    """None where too few views share anything. like: of the same photographs, by other cameras."""
    working = working_views(scene.mesh, scene.views, scene.kind, device, seed, like)
    return None if working is None else _Placed(scene, working, given, *_poses(working, given))


def _agrees_better(other: _Placed, placed: _Placed, common: Device) -> bool:
    """Whether views on a device, at the working size, agree better than without it when both have found their poses.

    Poses that drift look as a device that is a little off: what they make up for by themselves is theirs.
    """
    working = placed.working
    checked, features = working.checked, working.features
    before = sample_points(features, working.K, placed.poses, checked, working.size)
    after = sample_points(features, common.lens @ working.K, other.poses, checked, working.size)
    values = before.value[..., None], after.value[..., None]
    return better(*values, before.valid & after.valid, checked, working.checked_cell, CONTRAST_SCALE)


def _poses(working: WorkingViews, given: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Poses [V,4,4] that the checked points approve of, and columns [V] for the report.

    given: [V,4,4], what they have to be better than; where the search begins is in `working`.
    """
    checked, cell = working.checked, working.checked_cell
    poses = working.K, working.given
    found = refine_poses(working.contrast, working.size, working.kind, *poses, working.fitted, working.spread)
    before = sample_points(working.features, working.K, given, checked, working.size)
    good = torch.ones(len(given), dtype=torch.bool, device=given.device)
    # One view's return to its given pose changes what the others are compared with.
    while True:
        after = sample_points(working.features, working.K, found, checked, working.size)
        values = before.value[..., None], after.value[..., None]
        approved = improved(*values, before.valid & after.valid, checked, cell, CONTRAST_SCALE)
        if approved[good].all():
            break
        good &= approved
        found = torch.where(good[:, None, None], found, given)
    after = sample_points(working.features, working.K, found, checked, working.size)
    values = before.value[..., None], after.value[..., None]
    old = disagreement(values[0], before.valid, checked, CONTRAST_SCALE)
    if not better(*values, before.valid & after.valid, checked, cell, CONTRAST_SCALE):
        return given, {"residual_before": old, "residual_after": old, "kept_pose": torch.ones_like(good)}
    new = disagreement(values[1], after.valid, checked, CONTRAST_SCALE)
    return found, {"residual_before": old, "residual_after": new, "kept_pose": ~good}


def _exposures(working: WorkingViews, world_to_camera: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Gain and offset [V,3] that the checked points approve of, and columns [V] for the report."""
    checked, cell = working.checked, working.checked_cell
    fit = sample_points(working.features, working.K, world_to_camera, working.fitted, working.size)
    gain, offset = fit_exposure(sample_colors(working.color, fit.pixel), fit.valid, working.fitted)
    seen = sample_points(working.features, working.K, world_to_camera, checked, working.size)
    raw = sample_colors(working.color, seen.pixel)
    corrected = corrected_color(raw, gain[:, None], offset[:, None])
    good = improved(raw, corrected, seen.valid, checked, cell, COLOR_SCALE)[:, None]
    gain, offset = torch.where(good, gain, 1.0), torch.where(good, offset, 0.0)
    corrected = corrected_color(raw, gain[:, None], offset[:, None])
    old = disagreement(raw, seen.valid, checked, COLOR_SCALE)
    new = disagreement(corrected, seen.valid, checked, COLOR_SCALE)
    if not better(raw, corrected, seen.valid, checked, cell, COLOR_SCALE):
        gain, offset, new, good = torch.ones_like(gain), torch.zeros_like(offset), old, torch.zeros_like(good)
    return gain, offset, {"color_before": old, "color_after": new, "kept_exposure": ~good[:, 0]}


def _plain(value: Tensor) -> Any:
    """A bool, a number of four decimals (None for nan), or a list of them."""
    if value.ndim:
        return [_plain(part) for part in value]
    if value.dtype == torch.bool:
        return bool(value)
    return None if bool(value.isnan()) else round(float(value), 4)
