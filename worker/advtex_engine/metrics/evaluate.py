"""How well a textured model shows what photographs show that it was not made from.

A pixel counts where the scan's mesh is hit and the device's depth, where the scan has any, is there and agrees with it:
the same pixels for every model of a scan. Where the model itself shows nothing, or a surface elsewhere, it is scored as
black: leaving difficult faces out does not help. Outside of these pixels both images hold the photograph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import EngineError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import TO_Y_UP, Atlas, Fragments, Mesh, Scene, View, evenly_spread
from advtex_engine.ingest.decode import fill_masked
from advtex_engine.ingest.read import load_scene, opened, sound_scan
from advtex_engine.mesh.models import load_model, load_reference
from advtex_engine.metrics.budget import LPIPS_SCORES, budget_scores
from advtex_engine.metrics.image_metrics import METRICS, nearest_patch_loss
from advtex_engine.metrics.lpips import Lpips, WeightsError, load_lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.metrics.sharpness import band_error, flat_energy, s3_ratio
from advtex_engine.refine.heldout import refine_heldout
from advtex_engine.render.pictures import contact_sheet
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import GBuffer, gbuffer, shade_layers
from advtex_engine.runtime.available_memory import available_memory
from advtex_engine.runtime.files import json_text, write_atomically
from advtex_engine.runtime.threads import in_threads, one_thread_each

DEPTH_AGREEMENT = 0.05
"""Metres between the depths of device, scan's mesh and model."""
LEFT_BEHIND = 0.2
"""Of a view's pixels, the most that a refined camera may not find on the reference. Of views of five scans up to .12
are left behind; of a texture that shows something else .2 to .65, since any pose is as good as another."""
MIN_PIXELS = 500
"""Views in which fewer pixels count are left out."""
PATCH_QUERIES = 1000
"""Patches per view whose nearest ones are sought."""
TEXELS_PER_SAMPLE, MIN_SUPERSAMPLE, MAX_SUPERSAMPLE = 1.5, 2, 6
"""A pixel is sampled so finely that neighboring samples lie this far apart in the texture, within these bounds."""
SHEET_VIEWS = 12
# What the patches of a view take while it is scored, and all else by its size; 300 MB were seen at 640x480.
BYTES_PER_SCORED_VIEW, BYTES_PER_SCORED_PIXEL = 270 << 20, 400

Metric = Callable[[Tensor, Photograph], float]

VIEW_METRICS: dict[str, Metric] = {**METRICS, "band_error": band_error, "s3_ratio": s3_ratio}
PATCH_METRICS: dict[str, Metric] = {
    "nearest_patch": lambda image, truth: nearest_patch_loss(image, truth.color, truth.mask, queries=PATCH_QUERIES),
    "nearest_patch_reverse": lambda image, truth: nearest_patch_loss(
        truth.color, image, truth.mask, queries=PATCH_QUERIES
    ),
}
Scores = dict[str, float | None]


@dataclass(frozen=True)
class Comparison:
    """A view's photograph and what the model shows in its place.

    photo, image: [H,W,3] float32 sRGB in [0,1]; image equals photo outside the mask and is black where the model shows
    nothing. mask: [H,W] bool, the pixels that count; covered: those of them where the model is.
    """

    name: str
    photo: Tensor
    image: Tensor
    mask: Tensor
    covered: Tensor


@dataclass(frozen=True)
class Evaluation:
    """Scores per view and their means; `missing` says why a metric has none.

    refined: per view how far its camera was moved against the model before scoring, None if no camera was.
    """

    per_view: list[dict[str, Any]]
    mean: dict[str, Any]
    missing: dict[str, str]
    refined: list[dict[str, Any]] | None = None


def evaluate(
    model: Path,
    scan: Path,
    *,
    size: tuple[int, int] | None = None,
    holdout: int | None = None,
    layout: str | None = None,
    reference: Path | None = None,
    weights: Path | None = None,
    sheet: Path | None = None,
    refine_poses: bool = False,
    budget: bool = False,
    monitor: Monitor | None = None,
) -> Evaluation:
    """Scores an OBJ or GLB against a scan's held-out frames, or against all frames without `holdout`.

    size: width and height of the renders and photographs in pixels; None keeps the scan's. layout: of the scan; None
    takes the one that fits best. reference: a mesh file that
    decides which pixels count, by default the scan's mesh; models compared with each other need the same one. weights:
    see `perceptual.weights_folder`; without them `lpips` and `lpips_full` are None. sheet: PNG to write, photograph |
    render | difference. refine_poses: the frames' poses are refined against the model first, to tell a texture that is
    displaced from one that is wrong. budget: LPIPS is split into what pose, tone, displacement, the photographs' motion
    and content cost (`budget.py`). Raises ScanError, ModelError, OptionError, and EngineError when no view can be
    scored.
    """
    scene = heldout_scene(scan, TextureConfig(size=size, holdout=holdout, layout=layout), monitor or Monitor())
    target = scene.mesh if reference is None else load_reference(reference)
    atlas, texture = load_model(model)
    if model.suffix.lower() == ".glb":
        atlas = replace(atlas, mesh=_from_y_up(atlas.mesh, scene.up_axis))
    lpips, missing = configured_lpips(weights)
    if budget and lpips is None:
        missing |= dict.fromkeys(LPIPS_SCORES, missing["lpips"])
    views, refined = scene.views, None
    if refine_poses:
        views, refined = refine_heldout(atlas, texture, views, scene.kind)
    shown = {view.name for view in evenly_spread(views, SHEET_VIEWS)} if sheet is not None else set()
    rows, pictures = list[dict[str, Any]](), list[tuple[View, Comparison]]()
    for view in views:
        comparison = compare(atlas, texture, view, target)
        if comparison is None:
            continue
        row = {"view": view.name, **score(comparison, lpips, {**VIEW_METRICS, **PATCH_METRICS})}
        rows.append(row | (view_budget(atlas, texture, view, comparison, target, scene.kind, lpips) if budget else {}))
        if view.name in shown:
            pictures.append((view, comparison))
    if not any(row["coverage"] for row in rows):
        raise EngineError(
            f"{model}: no view shows it where the scan's mesh is; export it in the scan's world coordinates, in metres"
        )
    if sheet is not None and pictures:
        _write_sheet(pictures, sheet)
    return Evaluation(rows, mean_scores(rows), missing, refined)


def view_budget(
    atlas: Atlas, texture: Tensor, view: View, given: Comparison, reference: Mesh, kind: str, lpips: Lpips | None
) -> Scores:
    """`budget_scores` of a view, and by how many pixels its camera was moved.

    given: its comparison at the given pose, whose pixels count all along. Those at which the refined camera does not
    find the reference count by the pose's fault alone, and hold the photograph from then on. Not so those at which the
    device's depth just agreed, of which a camera that moves by a pixel loses many: it may be twice as far off then. A
    camera that leaves LEFT_BEHIND of them is not the photograph's, and the given one stays.
    """
    color = torch.from_numpy(fill_masked(view.color.numpy(), given.mask.numpy()))
    masked = replace(view, color=color, mask=given.mask)
    # A pixel's motion, which LPIPS sees, is hardly significant; where the better guess is the worse pose, that shows.
    (moved,), (report,) = refine_heldout(atlas, texture, [masked], kind, standard_errors=0.0)
    shown = None
    if not report["kept_pose"]:
        right = replace(view, camera=moved.camera, mask=given.mask)
        shown = compare(atlas, texture, right, reference, 2 * DEPTH_AGREEMENT)
    if shown is None or shown.mask.sum() < (1 - LEFT_BEHIND) * given.mask.sum():
        posed, known, pixels = given.image, given.covered, 0.0
    else:
        posed, known, pixels = shown.image, shown.covered, report["moved_pixels"]
    scores = budget_scores(given.photo, given.image, posed, given.mask, known, lpips)
    return {**scores, "pose_pixels": pixels}


def configured_lpips(folder: Path | None = None) -> tuple[Lpips | None, dict[str, str]]:
    """LPIPS, or None and the reason per metric that goes without it."""
    try:
        return load_lpips(folder), {}
    except WeightsError as error:
        return None, {name: str(error) for name in ("lpips", "lpips_full")}


def compare(
    atlas: Atlas, texture: Tensor, view: View, reference: Mesh | None = None, tolerance: float = DEPTH_AGREEMENT
) -> Comparison | None:
    """The model at the view's camera, beside the photograph; None when fewer than MIN_PIXELS count.

    texture: [atlas.height,atlas.width,3] uint8 sRGB or float in [0,1]. reference: the mesh that decides which pixels
    count, by default the model's own. tolerance: metres between its depth and the device's.
    """
    looked = _look(atlas, view, reference, tolerance)
    return None if looked is None else looked.shows(texture)


@dataclass(frozen=True)
class _Looked:
    """A view of a model, whatever its texture. mask, covered: those of `Comparison`."""

    view: View
    mask: Tensor
    covered: Tensor
    buffer: GBuffer

    @cached_property
    def photo(self) -> Tensor:
        return self.view.color.to(torch.float32) / 255

    def shows(self, texture: Tensor) -> Comparison:
        color, cover = shade_layers(self.buffer, texture)
        color = color / cover.clamp(min=1e-6)[..., None]
        image = torch.where(self.mask[..., None], color * self.covered[..., None], self.photo)
        return Comparison(self.view.name, self.photo, image, self.mask, self.covered)


def _look(
    atlas: Atlas, view: View, reference: Mesh | None = None, tolerance: float = DEPTH_AGREEMENT
) -> _Looked | None:
    """None when fewer than MIN_PIXELS count; reference, tolerance: as for `compare`."""
    fragments = rasterize(atlas.mesh, view.camera)
    target = fragments if reference is None else rasterize(reference, view.camera)
    mask = target.face_index >= 0
    if view.depth is not None:
        mask = mask & (view.depth > 0) & ((view.depth - target.depth).abs() < tolerance)
    if view.mask is not None:
        mask = mask & view.mask
    if int(mask.sum()) < MIN_PIXELS:
        return None
    covered = mask & (fragments.face_index >= 0) & ((fragments.depth - target.depth).abs() < DEPTH_AGREEMENT)
    return _Looked(view, mask, covered, gbuffer(atlas, view.camera, _supersample(atlas, fragments)))


def score(
    comparison: Comparison, lpips: Lpips | None, metrics: dict[str, Metric], truth: Photograph | None = None
) -> Scores:
    """All scores of a view; None where a metric says nothing (no weights, no flat pixels).

    truth: the comparison's photograph and mask, where more is compared with them.
    """
    image, mask = comparison.image, comparison.mask
    truth = Photograph(comparison.photo, mask) if truth is None else truth
    scores: Scores = {"lpips": None, "lpips_full": None}
    if lpips is not None:
        scores = {"lpips": lpips.masked(image, truth), "lpips_full": lpips.on_black(image, truth)}
    scores |= {name: metric(image, truth) for name, metric in metrics.items()}
    scores["flat_energy"] = flat_energy(image, truth, comparison.covered)
    scores["coverage"] = float(comparison.covered.sum() / mask.sum())
    scores["mask_share"] = float(mask.to(torch.float32).mean())
    return {name: None if value is None or math.isnan(value) else value for name, value in scores.items()}


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Per metric the mean over the views that have it, None when none has; `views` is their number."""
    means: dict[str, Any] = {}
    for name in [name for name in rows[0] if name != "view"] if rows else []:
        known = [row[name] for row in rows if row[name] is not None]
        means[name] = sum(known) / len(known) if known else None
    return means | {"views": len(rows)}


def score_views(
    atlas: Atlas, textures: Mapping[str, Tensor], views: Sequence[View], lpips: Lpips | None
) -> dict[str, dict[str, Any]]:
    """Per texture the means over views of a model on the scan's own mesh, without the costly nearest patches; empty
    if none counts.

    On the CPU, where the same model has the same scores on every machine; as many views side by side as there are
    threads and room, since most of a view's work is of one thread.
    """

    def scored(view: View) -> dict[str, Scores] | None:
        looked = _look(atlas, view)
        if looked is None:
            return None
        truth = Photograph(looked.photo, looked.mask)
        return {name: score(looked.shows(texture), lpips, VIEW_METRICS, truth) for name, texture in textures.items()}

    pixels = max((view.camera.width * view.camera.height for view in views), default=1)
    room = available_memory(torch.device("cpu")) // 2
    at_once = min(torch.get_num_threads(), room // (BYTES_PER_SCORED_VIEW + BYTES_PER_SCORED_PIXEL * pixels))
    with one_thread_each():
        found = [rows for rows in in_threads(scored, views, max(1, at_once)) if rows is not None]
    return {name: mean_scores([rows[name] for rows in found]) if found else {} for name in textures}


def write_json(path: Path, evaluation: Evaluation, described: dict[str, Any]) -> None:
    """described: what was evaluated, put before the scores."""
    content = {**described, **vars(evaluation)}
    write_atomically(path, json_text(content, indent=1).encode() + b"\n")


def heldout_scene(scan: Path, config: TextureConfig, monitor: Monitor) -> Scene:
    """The scan with the frames as its views that config.holdout leaves out of a run; the others are not decoded."""
    with opened(scan) as archive:
        manifest, mesh, _ = sound_scan(archive, config.layout)
        every = config.holdout
        frames = tuple(
            frame for position, frame in enumerate(manifest.frames) if every is None or position % every == every // 2
        )
        if not frames:
            raise EngineError(f"{scan}: no frame is held out; lower the holdout below {every}")
        manifest = replace(manifest, frames=frames)
        return load_scene(archive, manifest, mesh, replace(config, holdout=None), monitor)


def _from_y_up(mesh: Mesh, up_axis: str) -> Mesh:
    """A glTF's mesh, +Y up, turned into the scan's world."""
    x, y, z, w = TO_Y_UP[up_axis]
    axis = torch.tensor([x, y, z], dtype=torch.float64)
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    turn = torch.eye(3, dtype=torch.float64) + 2 * w * cross + 2 * cross @ cross
    return replace(mesh, v_pos=(mesh.v_pos.double() @ turn).to(torch.float32))


def _supersample(atlas: Atlas, fragments: Fragments) -> int:
    """Samples per pixel and axis, from the texture's median density in neighboring pixels of the same face."""
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    face = fragments.face_index
    left = ((face[:, :-1] >= 0) & (face[:, :-1] == face[:, 1:])).nonzero()
    if len(left) == 0:
        return MIN_SUPERSAMPLE
    rows, columns = left.unbind(1)
    corners = mesh.v_uv[mesh.t_uv_idx[face[rows, columns].long()]]
    weights = fragments.barycentric
    step = ((weights[rows, columns + 1] - weights[rows, columns])[:, :, None] * corners).sum(1)
    texels = (step * step.new_tensor([atlas.width, atlas.height])).norm(dim=1)
    return min(MAX_SUPERSAMPLE, max(MIN_SUPERSAMPLE, math.ceil(float(texels.median()) / TEXELS_PER_SAMPLE)))


def _write_sheet(pictures: Sequence[tuple[View, Comparison]], path: Path) -> None:
    rows = [
        (comparison.image * comparison.mask[..., None], 0.5 + comparison.image - comparison.photo)
        for _, comparison in pictures
    ]
    contact_sheet([view for view, _ in pictures], rows, ("render", "render minus photograph"), path)
