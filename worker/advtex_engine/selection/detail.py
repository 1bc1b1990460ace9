"""Which photographs resolve less of a place than they could from where they are: the data term's part for blur.

A smeared photograph from close by covers more pixels of a door than a sharp one from further away, and shows less of
it. What a photograph resolves is measured on the surface, per metre and not per pixel: at an edge that is blurred over
a width w, the squared gradient sums up to 1 / w. A sharp photograph's w is a pixel or so, so its energy grows with the
pixels that it has per metre; a smeared one's is what the motion was. How much there is to be seen differs from place to
place, and how strong it is from exposure to exposure: so each photograph's energy is taken relative to its own, in the
same region, at a density of pixels that all candidates have (a level of its pyramid). What then falls short of the
candidates' median is the factor by which the photograph resolves less than its distance promises, in the units of the
data term's resolution. No photograph is compared with another's pixels, so cameras may be off.

`frame_blur` knows one number per frame, but a camera that moves smears what is near more than what is far, and a lens
that is out of focus blurs the one and not the other.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.render.filtering import blurred
from advtex_engine.render.reproject import MIN_DEPTH
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.candidates import Candidates, edge_distance, luminance

# Of 1 and 1.5, chosen leave-one-out on five scans and two drawn rooms: a place that is resolved less by a factor
# of two is a little worse than one of half the pixels per metre.
WEIGHT = 1.5
LEVELS = 5  # of a photograph's pyramid
BLOCK = 8  # pixels a side whose gradients are one tensor
COARSE = 4.0  # the common density: of the candidates' median, that by which it is coarser
GRAIN = 2 / 255  # gradients per pixel that say nothing: sensor noise, rounding, JPEG
MOST = 3.0  # of the logarithm
EDGE = 3  # pixels around a depth edge that are not looked at: views disagree there for other reasons
LEAST = 0.1  # share of a region that must be seen


def blur_cost(mesh: Mesh, candidates: Candidates, maps: ViewMaps) -> Tensor:
    """[T,K] >= 0, the part for what each candidate resolves less than its pixels per metre promise.

    WEIGHT times the logarithm of the factor; 0 where there is nothing to be seen, or no candidate. maps: those of the
    candidates. Not differentiable.
    """
    seen = candidates.view >= 0
    density, fine, coarse = candidates.cost.new_full((3, *seen.shape), torch.nan).unbind()
    for view, face, place in _placed(candidates, maps):
        metric, _ = image_metric(mesh, face, maps, view)
        density[face, place] = (metric[0] * metric[2] - metric[1].square()).clamp(min=0).sqrt().sqrt()
    common = density.nanmedian(1, keepdim=True).values / COARSE
    level = (density / common).log2().nan_to_num(0.0).clamp(0, LEVELS - 1.001)
    for view, face, place in _placed(candidates, maps):
        metric, pixel = image_metric(mesh, face, maps, view)
        tensors = gradient_tensors(maps, view)
        column, row = (pixel / BLOCK).long().unbind(1)
        row, column = row.clamp(0, tensors.shape[2] - 1), column.clamp(0, tensors.shape[3] - 1)
        xx, xy, yy = tensors[:, :, row, column].unbind(1)
        energy = xx * metric[0] + 2 * xy * metric[1] + yy * metric[2]
        fine[face, place] = energy[0]
        below = level[face, place].long()[None]
        finer, coarser = energy.gather(0, below)[0], energy.gather(0, below + 1)[0]
        coarse[face, place] = torch.lerp(finer, coarser, level[face, place] - below[0])
    # Grain counts on either side: flat surfaces, where there is nothing else, promise nothing.
    grain, shown = (GRAIN * density).square(), coarse + (GRAIN * common).square()
    sharp = ((fine + grain) / (density * shown)).nanmedian(1, keepdim=True).values
    short = ((density * sharp * shown + grain) / (fine + 2 * grain)).log()
    return torch.where(seen, WEIGHT * short.clamp(0, MOST), 0.0).nan_to_num(0.0)


def _placed(candidates: Candidates, maps: ViewMaps) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Each view that is a candidate, the faces that it is one for, and its places there."""
    for view in range(maps.count):
        face, place = (candidates.view == view).nonzero(as_tuple=True)
        if len(face):
            yield view, face, place


def image_metric(mesh: Mesh, face: Tensor, maps: ViewMaps, view: int) -> tuple[Tensor, Tensor]:
    """Where faces [N] lie in a view: g [3,N], and the pixels [N,2] of their centers.

    g holds xx, xy and yy of A A^T, where A, pixels per metre, takes directions on the face to the image: a gradient d
    per pixel has d^T (A A^T) d per square metre.
    """
    corners = mesh.v_pos[mesh.t_pos_idx[face]]
    normal = F.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1)
    pose = maps.world_to_camera[view].to(corners)
    x, y, z = (corners.mean(1) @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    z = z.clamp(min=MIN_DEPTH)
    fx, fy, cx, cy = maps.intrinsics[view].to(corners).unbind()
    across, down, along = normal @ pose[:3, :3].T[:, 0], normal @ pose[:3, :3].T[:, 1], normal @ pose[:3, :3].T[:, 2]
    # Rows of the projection's derivative, fx / z (e_x - x/z e_z) and likewise for y, less their parts along the normal.
    u, v = x / z, y / z
    off_x, off_y = across - u * along, down - v * along
    scale_x, scale_y = fx / z, fy / z
    xx = scale_x**2 * (1 + u * u - off_x * off_x)
    xy = scale_x * scale_y * (u * v - off_x * off_y)
    yy = scale_y**2 * (1 + v * v - off_y * off_y)
    return torch.stack((xx, xy, yy)), torch.stack((fx * u + cx, fy * v + cy), 1)


def gradient_tensors(maps: ViewMaps, view: int) -> Tensor:
    """[LEVELS,3,rows,columns]: xx, xy and yy of a photograph's gradients at each level of its pyramid, averaged.

    Luminance in [0,1] per pixel of the whole photograph; a place for each block of BLOCK pixels, NaN where hardly
    anything is seen.
    """
    height, width = maps.height, maps.width
    depth = maps.depth[view].to(maps.device, torch.float32).view(height, width)
    image = luminance(maps.color[view].to(maps.device)).view(1, 1, height, width)
    counts = (edge_distance(depth) >= EDGE).to(image)[None, None]
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    found = []
    for level in range(LEVELS):
        if level:
            image, counts = (F.avg_pool2d(each, 2, ceil_mode=True) for each in (image, counts))
        padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
        x, y = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
        products = torch.cat((x * x, x * y, y * y, torch.ones_like(x)), 1) * counts
        products[:, :3] /= 4**level * 4
        found.append(F.adaptive_avg_pool2d(products, (rows, columns))[0])
    sums = blurred(torch.cat(found), 1.0).view(LEVELS, 4, rows, columns)
    return torch.where(sums[:, 3:] > LEAST, sums[:, :3] / sums[:, 3:], torch.nan)
