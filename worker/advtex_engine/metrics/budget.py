"""What a held-out view's LPIPS is made of: its pose, its tone, displacement, and the content that is left.

One thing after the other is put right in the render, in this order, and LPIPS over the same pixels is taken again:

1. pose: the view's camera is refined against the model (`refine_heldout`) and the model rendered anew. That comes first
   since it looks at local contrast, which no tone changes, while tones fitted to a displaced render are too faint. Six
   degrees of freedom know of parallax, and rendering resamples nothing, where a homography fits planes and blurs.
   Pixels that count by the wrong pose alone go with it; what the model leaves out at the right one stays black.
2. tone: a robust gain and offset per channel (exposure, white balance), then wide averages (vignetting, light that
   depends on the view), both from pixels that are clipped in neither image.
3. displacement: a dense flow moves the render onto the photograph. It is smooth, so it cannot copy detail, and pixels
   stay that would come from where none count; what wrong geometry, cameras and misplaced texture cost beyond its reach
   counts as content.
4. motion: the photograph's own blur along one direction, put onto the render. It is found by energies of gradients,
   direction by direction, which a render that is softer than its photograph has less of: no blur is found then, and
   none can hide that the texture lacks detail.
5. content: what is left. Softness, seams, clipped lights, parts that the mesh lacks.

A part's cost is the LPIPS before it was put right less that after it, and below 0 where that made things worse. The
five sum to the raw figure. `lpips_corrected`, pose and tone put right, is what the texture answers for: a view's own
camera and exposure are nobody's fault. Nor is its motion, but what is blurred forgives a texture's faults, so that it
is told beside.

No correction reads a pixel outside of those that count, and none touches those where the model shows nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.metrics.image_metrics import gradient_magnitude, luminance
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.refine.exposure import BRIGHT, DARK, GAIN_RANGE, ROBUST_SCALE
from advtex_engine.render.motion import motion_kernel, motions
from advtex_engine.render.texture import fill_holes
from advtex_engine.selection.toning import LARGEST, REACH

COSTS = ("pose_cost", "tone_cost", "displacement_cost", "motion_cost", "content_cost")
LPIPS_SCORES = ("lpips_corrected", *COSTS)
TABLE = {
    "lpips": "LPIPS",
    "pose_cost": "= pose",
    "tone_cost": "+ tone",
    "displacement_cost": "+ displacement",
    "motion_cost": "+ motion",
    "content_cost": "+ content",
    "lpips_corrected": "corrected",
    "pose_pixels": "pose off, px",
    "displacement_pixels": "displaced, px",
    "motion_pixels": "moved by, px",
    "flat_energy": "flat energy",
}
"""Columns of `format_budget`."""
FIT_REACH = 1 / 160
"""Of the view's width, the low-pass under which tones are fitted: displacements of some pixels hardly show."""
FIT_ROUNDS = 10
FLOW_REACH = 1 / 80
"""Of the view's width, the standard deviation of the flow's smoothing."""
INSIDE = 0.999
"""Share of a sample of the render that must lie on pixels that count."""
DIRECTIONS = 6
"""Along which gradients are compared, to find a motion."""

Array = NDArray[Any]  # float32; OpenCV does not say
Mask = NDArray[np.bool_]


def budget_scores(
    photo: Tensor, image: Tensor, posed: Tensor, mask: Tensor, known: Tensor, lpips: Lpips | None
) -> dict[str, float | None]:
    """LPIPS_SCORES of a view, None without LPIPS; `displacement_pixels`, None where the model shows nothing, and
    `motion_pixels`, how far the photograph's camera moved while it was exposed.

    photo, image: [H,W,3] float32 sRGB in [0,1], the photograph and the render at the given pose. posed: the render at
    the refined pose. mask: [H,W] bool, the pixels that count; known: those of them where `posed` shows the model.
    """
    assert photo.shape == image.shape == posed.shape == (*mask.shape, 3)
    toned = corrected_tone(posed, photo, known)
    flow = dense_flow(toned, photo, known)
    moved = warped(toned, flow, known)
    pixels, angle = own_motion(moved, photo, known)
    smeared = along_motion(moved, known, pixels, angle)
    scores: dict[str, float | None] = dict.fromkeys((*LPIPS_SCORES, "displacement_pixels"))
    scores["motion_pixels"] = pixels
    if lpips is not None:
        truth = Photograph(photo, mask)
        after = [lpips.masked(one, truth) for one in (image, posed, toned, moved, smeared)]
        corrected = after[2]
        costs = [*(before - then for before, then in itertools.pairwise(after)), after[-1]]
        scores |= {"lpips_corrected": corrected, **dict(zip(COSTS, costs, strict=True))}
    if bool(known.any()):
        detail = _detail(photo, known)[known]
        scores["displacement_pixels"] = float(flow.norm(dim=-1)[known][detail >= detail.median()].median())
    return scores


def corrected_tone(image: Tensor, photo: Tensor, known: Tensor) -> Tensor:
    """The image [H,W,3] in the photograph's exposure and wide averages where `known` [H,W]; elsewhere as it is."""
    clear = (known & _unclipped(image) & _unclipped(photo)).numpy()
    if not clear.any():
        return image
    ours, theirs, inside = image.numpy(), photo.numpy(), known.numpy()
    width = inside.shape[1]
    smooth = [_low_pass(picture, clear, FIT_REACH * width)[clear] for picture in (ours, theirs)]
    fitted = ours.copy()
    for channel in range(3):
        gain, offset = _gain_and_offset(smooth[0][:, channel], smooth[1][:, channel])
        fitted[..., channel] = gain * ours[..., channel] + offset
    difference = np.clip(theirs - fitted, -LARGEST / 255, LARGEST / 255)
    fitted += _low_pass(difference, clear, REACH * width)
    return torch.from_numpy(np.where(inside[..., None], np.clip(fitted, 0, 1), ours))


def _unclipped(image: Tensor) -> Tensor:
    return ((image > DARK) & (image < BRIGHT)).all(-1)


def _gain_and_offset(ours: Array, theirs: Array) -> tuple[float, float]:
    """theirs = gain * ours + offset, by least squares in which a residual of ROBUST_SCALE has half of its weight."""
    gain, offset = 1.0, float(np.median(theirs - ours))
    for _ in range(FIT_ROUNDS):
        weight = 1 / (1 + ((gain * ours + offset - theirs) / ROBUST_SCALE) ** 2)
        total = weight.sum()
        our_mean, their_mean = (weight * ours).sum() / total, (weight * theirs).sum() / total
        variance = (weight * (ours - our_mean) ** 2).sum()
        covariance = (weight * (ours - our_mean) * (theirs - their_mean)).sum()
        gain = float(np.clip(covariance / variance, *GAIN_RANGE)) if variance > 1e-6 * total else 1.0
        offset = float(their_mean - gain * our_mean)
    return gain, offset


def dense_flow(image: Tensor, photo: Tensor, known: Tensor) -> Tensor:
    """[H,W,2] pixels (right, down): what the photograph shows at p, the image shows at p + flow(p), where `known`.

    Dense inverse search (Kroeger et al. 2016) on luminance, then a Gaussian of FLOW_REACH over what is known. image,
    photo: [H,W,3] in [0,1].
    """
    inside = known.numpy()
    reach = FLOW_REACH * inside.shape[1]
    theirs, ours = (_gray(fill_holes(picture, known)) for picture in (photo, image))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)  # full size: half of it is a third of a pixel less exact
    flow = search.calc(theirs, ours, np.zeros((*inside.shape, 2), np.float32))
    return torch.from_numpy(_low_pass(flow, inside, reach))


def warped(image: Tensor, flow: Tensor, known: Tensor) -> Tensor:
    """What the image [H,W,3] shows at p + flow(p), at each p; pixels stay as they are that would come from elsewhere
    than `known`."""
    picture, inside = image.numpy(), known.numpy()
    rows, columns = np.indices(inside.shape, dtype=np.float32)
    x, y = columns + flow.numpy()[..., 0], rows + flow.numpy()[..., 1]
    moved = cv2.remap(fill_holes(image, known).numpy(), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    share = cv2.remap(inside.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return torch.from_numpy(np.where((inside & (share > INSIDE))[..., None], np.clip(moved, 0, 1), picture))


def own_motion(image: Tensor, photo: Tensor, known: Tensor) -> tuple[float, float]:
    """Length (pixels) and direction (radians, from right to down) of the motion that blurred the photograph and not the
    image, 0 pixels for none; of those looked at the one after which gradients' energies are as the photograph's.

    image, photo: [H,W,3] in [0,1], where `known` [H,W].
    """
    inside = cv2.erode(known.to(torch.uint8).numpy(), np.ones((3, 3), np.uint8), borderValue=0) > 0
    ours, theirs = (luminance(fill_holes(picture, known)).numpy() for picture in (image, photo))
    wanted = _gradient_energies(theirs, inside)

    def unlike(pixels: float, angle: float) -> float:
        energies = _gradient_energies(_smeared(ours, pixels, angle), inside)
        return float(np.square(np.log((energies + 1e-6) / (wanted + 1e-6))).sum())

    return min(motions(), key=lambda motion: unlike(*motion))


def _gradient_energies(gray: Array, inside: Mask) -> Array:
    """[DIRECTIONS]: sums of squared differences along each, of pixels two apart."""
    right, down = np.zeros_like(gray), np.zeros_like(gray)
    right[:, 1:-1], down[1:-1] = gray[:, 2:] - gray[:, :-2], gray[2:] - gray[:-2]
    right, down = right[inside].astype(np.float64), down[inside].astype(np.float64)
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    cosine, sine = np.cos(angles), np.sin(angles)
    energies: Array = right @ right * cosine**2 + 2 * (right @ down) * cosine * sine + down @ down * sine**2
    return energies


def along_motion(image: Tensor, known: Tensor, pixels: float, angle: float) -> Tensor:
    """The image [H,W,3] as a camera shows it that moves by so many pixels; what is not `known` [H,W] stays, and is
    brought in nowhere."""
    if pixels == 0:
        return image
    weight = known.to(torch.float32).numpy()
    share = np.maximum(_smeared(weight, pixels, angle), 1e-6)
    smeared = _smeared(image.numpy() * weight[..., None], pixels, angle) / share[..., None]
    return torch.from_numpy(np.where(weight[..., None] > 0, smeared, image.numpy()).astype(np.float32))


def _smeared(picture: Array, pixels: float, angle: float) -> Array:
    """Means along a line, with the weights of a Gaussian as wide as the line: motions are no uniform ones."""
    if pixels == 0:
        return picture
    kernel = motion_kernel(pixels, angle).numpy()
    smeared: Array = cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return smeared


def _detail(photo: Tensor, known: Tensor) -> Tensor:
    """[H,W]: mean square of the luminance's gradient near each pixel, of known pixels alone."""
    inside = known.numpy()
    reach = FLOW_REACH * inside.shape[1]
    gradient = gradient_magnitude(luminance(fill_holes(photo, known)))
    return torch.from_numpy(_low_pass(gradient.square()[..., None].numpy(), inside, reach)[..., 0])


def _gray(image: Tensor) -> NDArray[np.uint8]:
    return (luminance(image) * 255).round().clamp(0, 255).to(torch.uint8).numpy()


def _low_pass(values: Array, known: Mask, deviation: float) -> Array:
    """Averages [H,W,C] of the known pixels under a Gaussian; 0 where there are none."""
    weight = known.astype(np.float32)
    smooth = cv2.GaussianBlur(values * weight[..., None], (0, 0), deviation).reshape(values.shape)  # drops C = 1
    share = cv2.GaussianBlur(weight, (0, 0), deviation)
    return smooth / np.maximum(share, 1e-6)[..., None]


def format_budget(rows: Sequence[Mapping[str, Any]], mean: Mapping[str, Any]) -> str:
    """The views' budgets and their means as a table of text, a line each."""
    wide = max(len("view"), *(len(row["view"]) for row in rows))
    lines = ["  ".join(["view".ljust(wide), *TABLE.values()])]
    for row in (*rows, {**mean, "view": "mean"}):
        cells = ("-" if row[name] is None else format(row[name], ".4f") for name in TABLE)
        lines.append("  ".join([row["view"].ljust(wide), *map(str.rjust, cells, map(len, TABLE.values()))]))
    return "\n".join(lines)
