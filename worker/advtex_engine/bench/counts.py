"""Operations and bytes that the step's parts and the stages need at least: what their floors are computed from.

Bytes: what a part has to read and write once, each operand as the engine stores it; what a part hands on inside of
itself costs nothing, as if it were fused. Operations: 2 per multiply-add of the convolutions, exactly; of what is
done per pixel, texel, face or vertex about so many, as counted in the code. Terms that only some presets have
(alignment, features, Gabor energies, the start's own render) are not counted, nor what xatlas, image codecs and PNG do.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

LAYERS = ((6, 64, 2), (64, 128, 2), (128, 128, 2), (128, 128, 1), (128, 1, 1))
PARAMETERS = sum(16 * inputs * outputs + outputs for inputs, outputs, _ in LAYERS)
FLOAT = 4
ADAM_BYTES = 7 * FLOAT  # reads value, gradient and both moments, writes value and moments
ADAM_FLOPS = 12
IMAGE = 3 * FLOAT  # of a pixel
FOOTPRINT = 4 * 8  # of a pixel: four slots int32 and four weights
SAMPLE_FLOPS = 40  # a bilinear footprint and three channels through it
REPROJECT_FLOPS = 110  # unproject, move, project, compare four depths, sample
BICUBIC_FLOPS = 140  # the weights of 16 pixels, and three channels through them
VERTEX_FLOPS, FACE_FLOPS, PIXEL_FLOPS = 28, 110, 50  # of rasterization, per camera
STRIDE = 8  # of the pixels that overlaps are estimated on
PLACES = 3  # that view selection looks at, per face: half a corner, 1.5 midpoints, one centroid
CANDIDATES, ROUNDS = 16, 30  # of view selection's labels, and of its messages


@dataclass(frozen=True)
class Work:
    """flops, bytes on the device, and bytes that come from the host."""

    flops: float
    bytes: float
    uploaded: float = 0.0


def layer_sizes(width: int, height: int) -> list[int]:
    """Elements of the discriminator's input and of each layer's output, for one image of width x height."""
    sizes = [LAYERS[0][0] * width * height]
    for _, outputs, stride in LAYERS:
        width, height = (width - 2) // stride + 1, (height - 2) // stride + 1
        sizes.append(outputs * width * height)
    return sizes


def discriminator_flops(width: int, height: int) -> list[int]:
    """Floating-point operations (2 per multiply-add) of each layer's forward pass on one image of width x height."""
    outputs = layer_sizes(width, height)[1:]
    return [2 * 16 * layer[0] * size for layer, size in zip(LAYERS, outputs, strict=True)]


def step_flops(width: int, height: int) -> int:
    """The operations of one step's convolutions.

    Two forward passes; for each a weight gradient, and an input gradient except in the first layer; and one input
    gradient through all layers for the texture.
    """
    layers = discriminator_flops(width, height)
    return 2 * sum(layers) + 2 * sum(layers) + 2 * sum(layers[1:]) + sum(layers)


def step_parts(width: int, height: int, slots: int, activation: int) -> dict[str, Work]:
    """The parts of a step on a crop of width x height and a compact texture of `slots` texels.

    activation: bytes of a value in the discriminator's layers.
    """
    pixels, layers, sizes = width * height, discriminator_flops(width, height), layer_sizes(width, height)
    through = activation * sum(a + b for a, b in pairwise(sizes))  # every layer's in and out
    touched = min(4 * pixels, slots)
    # Source: depth, color, uv; auxiliary: depth, color; the condition, the real example, two masks and the footprint.
    drawn = pixels * (2 + 3 + 4 + 2 + 3 + 2 * IMAGE + 2 * FLOAT + FOOTPRINT)
    rendered = pixels * (FOOTPRINT + IMAGE) + touched * IMAGE
    scattered = pixels * (FOOTPRINT + IMAGE) + slots * IMAGE + touched * IMAGE
    back = through + activation * sum(sizes[1:])  # gradients in and out, and the outputs, whose signs leaky ReLU needs
    weights = PARAMETERS * activation
    return {
        "draw and reproject": Work((REPROJECT_FLOPS + BICUBIC_FLOPS) * pixels, drawn),
        "render and forward": Work(2 * sum(layers) + SAMPLE_FLOPS * pixels, rendered + 2 * through + weights),
        "texture backward": Work(sum(layers) + SAMPLE_FLOPS * pixels, back + weights + scattered),
        "discriminator backward and update": Work(
            2 * sum(layers) + 2 * sum(layers[1:]) + ADAM_FLOPS * PARAMETERS,
            # Once more every layer's input, for the weights' gradient.
            2 * (back + activation * sum(sizes[:-1])) + weights + PARAMETERS * ADAM_BYTES,
        ),
        "texture update": Work(3 * slots * ADAM_FLOPS, 3 * slots * ADAM_BYTES),
    }


def rasterization(views: int, pixels: int, faces: int, vertices: int) -> Work:
    """Rasterizing one mesh for `views` cameras: positions and faces are read; face, barycentrics and depth are kept."""
    flops = VERTEX_FLOPS * vertices + FACE_FLOPS * faces + PIXEL_FLOPS * pixels
    return Work(views * flops, views * (3 * FLOAT * vertices + 24 * faces))


def stage_works(
    *, views: int, pixels: int, faces: int, vertices: int, texels: int, slots: int, near: int, pictures: int, shown: int
) -> dict[str, Work]:
    """The stages that run on the device.

    pixels: of a view. texels: of the dense texture. slots: of them, those that views touch. near: ordered pairs of
    views whose overlap is estimated. pictures, shown: of the turntable, and the samples of one.
    """
    maps = rasterization(views, pixels, faces, vertices)
    drawn = rasterization(pictures, shown, faces, vertices)
    sampled = pixels // STRIDE**2
    edges = 1.5 * faces
    messages = 2 * edges * ROUNDS * CANDIDATES**2
    selection = Work(
        views * 2 * PLACES * faces * REPROJECT_FLOPS + 2 * messages + views * slots * SAMPLE_FLOPS,
        2 * views * pixels * (3 + 2) + FLOAT * messages + 2 * texels * IMAGE,
    )
    dilation = Work(texels * 4 / 3 * 24, texels * 4 / 3 * 2 * IMAGE)
    return {
        "upload": Work(0, 0, views * pixels * (3 + FLOAT)),
        # Of each pixel the measured depth is read, uv and depth are written.
        "view maps": Work(maps.flops, maps.bytes + views * pixels * (FLOAT + 4 + 2)),
        "overlaps and pairs": Work(near * sampled * REPROJECT_FLOPS, near * sampled * 4 * 2),
        "mean texture": Work(
            views * pixels * SAMPLE_FLOPS + dilation.flops,
            views * pixels * (3 + 4 + 2) + slots * (IMAGE + FLOAT) + dilation.bytes,
        ),
        "view selection": selection,
        "dilation": dilation,
        "pictures": Work(
            drawn.flops + pictures * shown * SAMPLE_FLOPS, drawn.bytes + pictures * (texels * IMAGE + shown * IMAGE)
        ),
    }
