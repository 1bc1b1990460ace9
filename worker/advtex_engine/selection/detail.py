"""Which photographs are smeared where, by what the others show there: the part of the data term for regional blur.

`frame_blur` knows one number per frame, but a camera that moves smears what is near more than what is far, and a lens
that is out of focus blurs the one and not the other. Here the fine detail of each photograph is compared, region by
region, with that of one texture rendered into the same view: the mean of all views, whose own blur is the same for each
of a face's candidates, as is what there is to be seen. Only less than the candidates' median counts, for more of it is
as likely grain, a highlight or an edge that lies beside its place as it is sharpness. And it counts as far as the mean
shows what the photographs show: where cameras are off by degrees, a photograph of little detail shows another thing.
WEIGHT and TOLERANCE were chosen on five scans together: all but one (which is rendered, and has no blur) gain, most
where the camera shook.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.render.filtering import blurred
from advtex_engine.render.texture import decode_uv, sample_image
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.candidates import Candidates, edge_distance, luminance, project_points

WEIGHT = 2.0
TOLERANCE = 0.2  # of the logarithm: views of one place that are all sharp differ by as much
FINE = 1.5  # pixels, the standard deviation of the low-pass whose rest is fine detail
REACH = 1 / 80  # of the view's width, the standard deviation of the weights that a region's detail is averaged with
BLOCK = 4  # pixels a side whose detail is one number
GRAIN = 2 / 255  # root mean square that says nothing: sensor noise, rounding, JPEG
MOST = 1.5  # of the logarithm, either way
EDGE = 3  # pixels around a depth edge that are not looked at: views disagree there for other reasons
LEAST = 0.05  # share of a region that must be seen


def blur_cost(mesh: Mesh, candidates: Candidates, maps: ViewMaps, mean: Tensor) -> Tensor:
    """[T,K] >= 0, the data term's part for what each candidate lacks in detail beside the median of its face's.

    maps: those of the candidates. mean: [H,W,3] float32 in [0,1], the mean texture of all views. Not differentiable.
    """
    center = mesh.v_pos[mesh.t_pos_idx].mean(1)
    found = torch.full((2, *candidates.cost.shape), torch.nan, device=candidates.cost.device)
    for view in range(maps.count):
        face, place = (candidates.view == view).nonzero(as_tuple=True)
        if len(face):
            pixel = project_points(center[face], maps, view)[0] / BLOCK
            regions = torch.stack(compare_detail(maps, mean, view))
            column, row = pixel.long().unbind(1)
            row, column = row.clamp(0, regions.shape[1] - 1), column.clamp(0, regions.shape[2] - 1)
            found[:, face, place] = regions[:, row, column]
    detail, likeness = found
    lack = detail.nanmedian(1, keepdim=True).values - detail
    shared = likeness.nanmedian(1, keepdim=True).values.clamp(min=0).square()
    cost: Tensor = WEIGHT * shared * (lack - TOLERANCE).clamp(min=0)
    return cost.nan_to_num(0.0)


def compare_detail(maps: ViewMaps, texture: Tensor, view: int) -> tuple[Tensor, Tensor]:
    """A photograph beside the texture's render, a value for each block of BLOCK pixels, [rows,columns] each.

    First the logarithm of the amplitude of fine detail in the photograph's region over that in the render's; then the
    correlation of what is no fine detail. 0 and 1 where hardly anything is seen.
    """
    one, height, width = maps.only(view), maps.height, maps.width
    depth = one.depth[0].to(torch.float32).view(height, width)
    size = texture.new_tensor([texture.shape[1], texture.shape[0]])
    photograph = luminance(one.color[0]).view(height, width)
    render = luminance(255 * sample_image(texture, decode_uv(one.uv[0]) * size)).view(height, width)
    images = torch.stack((photograph, torch.where(depth > 0, render, photograph)))
    counts = (edge_distance(depth) >= EDGE).to(images)
    coarse = blurred(images, FINE)
    fine = (images - coarse).square()
    parts = torch.cat((fine, coarse, coarse.square(), coarse.prod(0, keepdim=True), torch.ones_like(fine[:1])))
    sums = blurred(F.avg_pool2d(parts * counts, BLOCK, ceil_mode=True), REACH * width / BLOCK)
    share, (ours, theirs) = sums[-1], sums[:2]
    ratio = (ours + GRAIN**2 * share) / (theirs + GRAIN**2 * share).clamp(min=1e-12)
    detail = torch.where(share > LEAST, (0.5 * ratio.log()).clamp(-MOST, MOST), 0.0)
    moments = sums[2:-1] / share.clamp(min=1e-6)
    variance = (moments[2:4] - moments[:2].square()).clamp(min=0) + GRAIN**2
    covariance = moments[4] - moments[0] * moments[1] + GRAIN**2
    return detail, torch.where(share > LEAST, covariance / variance.prod(0).sqrt(), 1.0)
