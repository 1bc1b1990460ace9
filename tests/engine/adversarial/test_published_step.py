"""Consecutive steps of the paper's printed recipe against a plain twin in float64, on a 3D scene.

The twin is written from the paper's formulas (section 3 and supplement A) over the dense texture. Of the engine it
takes the view maps, the start, and which pairs and crops are drawn. Where the engine differs from the paper or from
its released code on purpose, the twin does as the engine:

- The source image is shown whole, and only residuals are nil where the auxiliary view does not see: the discriminator
  cannot tell the examples apart by holes that both have. The released code masks the source image as well.
- Warped colors are bicubic where all 16 pixels are foreground, since bilinear ones would teach their blur to the
  texture. The paper's and the released code's are bilinear everywhere.
- Patches count by their exact receptive fields inside the image and by the paper's two rules, in the texture's loss
  too. The released code has a threshold on a chained mean of the mask, for the discriminator alone.
- "More than half of the patch" is half of its foreground, since what is background says nothing about occlusion.
- The texture is in [0, 1], so that its learning rate is in those units. The released code's is in [-1, 1].
- A texel's centre is half a texel from the texture's border, as meshes mean uv. The released code spreads uv from the
  first centre to the last.
- While the discriminator is ahead Adam is not called, so that a step costs less. The released code hands it gradients
  of zero, on which its momentum goes on to move the discriminator.
- A view that is paired with itself is reprojected as well, so that all draws take one path. The released code copies
  it.
- The crop's size is fixed, so that a step can be captured once. The released code's varies with its corner.
- Both players move on gradients of the same forward passes, which saves one. The paper alternates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.examples import Examples, InputForm, assemble
from advtex_engine.adversarial.losses import patch_masks
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.adversarial.pair_sampler import Choice, DrawnPair
from advtex_engine.core.config import PRINTED, Preset
from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.render.pairs import related_pairs
from advtex_engine.render.texture import sample_texels
from advtex_engine.render.view_maps import ViewMaps, build_view_maps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDTH, HEIGHT, TEXTURE = 160, 120, 128
STEPS, FIRST = 50_000, 998  # lambda falls at step 1,000
THETA_Z = 0.03  # metres, of an object
SEED, PAIRS = 28, [(1, 2), (2, 2), (0, 0), (2, 1)]  # the source and auxiliary views that it draws
ROUNDING = 2e-5  # pixels or metres, of float32; nothing that is compared may be nearer to a threshold


def mesh() -> Mesh:
    """A board that recedes to the right, and a card before it."""
    board = [[-1.1, -1.3, 1.2], [3.06, -1.3, 4.4], [3.06, 1.3, 4.4], [-1.1, 1.3, 1.2]]
    card = [[-0.45, -0.35, 1.66], [-0.1, -0.35, 1.3], [-0.1, 0.2, 1.3], [-0.45, 0.2, 1.66]]
    uv = [[0.02, 0.02], [0.7, 0.02], [0.7, 0.7], [0.02, 0.7], [0.75, 0.75], [1.0, 0.75], [1.0, 1.0], [0.75, 1.0]]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    return Mesh(torch.tensor(board + card), faces, torch.tensor(uv), faces)


def camera(x: float, y: float, degrees: float, focal: float) -> Camera:
    """At (x, y, 0), turned about the y axis."""
    middle = (WIDTH / 2 + 2 * x, HEIGHT / 2 - 2 * x)
    K = torch.tensor([[focal, 0, middle[0]], [0, focal + 2, middle[1]], [0, 0, 1]], dtype=torch.float64)
    pose, angle = torch.eye(4, dtype=torch.float64), math.radians(degrees)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:2, 3] = torch.tensor([x, y])
    return Camera(K, torch.linalg.inv(pose), WIDTH, HEIGHT)


def optimizer(network: PatchDiscriminator, preset: Preset = PRINTED) -> AdversarialOptimizer:
    """Of three views that share much; their colors differ from the start's by so much that no sign is for rounding."""
    random, views = torch.Generator().manual_seed(1), []
    rows, columns = torch.arange(HEIGHT)[:, None], torch.arange(WIDTH)
    cameras = [camera(0.0, 0.0, 0.0, 130.0), camera(0.21, 0.12, 2.0, 140.0), camera(-0.23, -0.1, -3.0, 135.0)]
    for index, at in enumerate(cameras):
        coarse = torch.rand((1, 3, HEIGHT // 4, WIDTH // 4), generator=random)
        smooth = torch.nn.functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bilinear")[0].permute(1, 2, 0)
        empty = (rows < 61 + columns / 30) & (columns > 71 + rows / 9)
        hole = (rows - 77) ** 2 + (columns - 27 - 15 * index) ** 2 < 45
        views.append(View(f"{index}", at, (90 + 75 * smooth).to(torch.uint8), mask=~(empty | hole)))
    maps = build_view_maps(Atlas(mesh(), TEXTURE, TEXTURE, "scan", 2), tuple(views), "object")
    start = 0.2 * torch.rand(maps.slots, 3, generator=random)
    start[:, 2] += 0.8
    of = AdversarialOptimizer(
        maps,
        related_pairs(maps, "object", 15.0, 0.3),
        start,
        preset,
        kind="object",
        steps=STEPS,
        generator=torch.Generator().manual_seed(SEED),
        discriminator=network,
    )
    of.bfloat16, of.form, of.index = False, InputForm(), FIRST
    return of


def fresh_network() -> PatchDiscriminator:
    return PatchDiscriminator(torch.Generator().manual_seed(2))


def decided_network() -> PatchDiscriminator:
    """One with an opinion on every patch, that takes hardly any example for real: on one of the draws it is ahead."""
    network, random = fresh_network(), torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(2.2)
            if parameter.ndim == 1:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=random))
        parameter.fill_(-2.0)
    return network


@dataclass(frozen=True)
class Example:
    """What the paper's loader makes of one pair; images [h,w,3] in [-1,1], masks [h,w].

    texels: [h,w,4] of the flattened texture, with weights. margin: how far the nearest pixel is from a threshold.
    """

    condition: Array
    real: Array
    foreground: Mask
    visible: Mask
    texels: NDArray[np.int64]
    weights: Array
    margin: float


def corner(position: Array, size: int) -> NDArray[np.int64]:
    """The first of the two grid cells whose centres are about a position."""
    return np.clip(np.floor(position - 0.5), 0, size - 2).astype(np.int64)


def cubic(t: Array) -> list[Array]:
    """Keys' weights, a = -3/4, of the samples at -1, 0, 1 and 2 for a position t in [0, 1)."""
    a = -0.75
    far = [a * s**3 - 5 * a * s**2 + 8 * a * s - 4 * a for s in (1 + t, 2 - t)]
    near = [(a + 2) * s**3 - (a + 3) * s**2 + 1 for s in (t, 1 - t)]
    return [far[0], near[0], near[1], far[1]]


def warped(maps: ViewMaps, a: int, b: int, rows: Array, columns: Array) -> tuple[Array, Mask, float]:
    """Image b seen by pixels of view a, [h,w,3] in [0,255], where it sees the same, and the least margin."""
    size = (maps.height, maps.width)
    depths, images = (each.double().numpy().reshape(-1, *size, *each.shape[2:]) for each in (maps.depth, maps.color))
    d_A, d_B, I_B = depths[a][rows, columns], depths[b], images[b]
    K_A, K_B = (np.array([[f, 0, u], [0, g, v], [0, 0, 1]]) for f, g, u, v in maps.intrinsics.double()[[a, b]].numpy())
    inverse_T_A, inverse_T_B = maps.world_to_camera.numpy()[[a, b]]
    P_A = np.stack((columns + 0.5, rows + 0.5, np.ones(rows.shape)), -1)
    p_A = d_A[..., None] * (P_A @ np.linalg.inv(K_A).T)
    moved = inverse_T_B @ np.linalg.inv(inverse_T_A)
    p_B = p_A @ moved[:3, :3].T + moved[:3, 3]
    z = p_B[..., 2]
    assert (z[d_A > 0] > 0.5).all()
    x, y = np.moveaxis((p_B @ K_B.T)[..., :2] / np.where(d_A > 0, z, 1.0)[..., None], -1, 0)

    borders = np.stack((x - 0.5, maps.width - 0.5 - x, y - 0.5, maps.height - 0.5 - y))
    left, top = corner(x, maps.width), corner(y, maps.height)
    right, down = x - 0.5 - left, y - 0.5 - top
    difference, covered, bilinear = np.full(z.shape, np.inf), np.zeros(z.shape), np.zeros((*z.shape, 3))
    for i, j in np.ndindex(2, 2):
        neighbor = d_B[top + i, left + j]
        weight = (down if i else 1 - down) * (right if j else 1 - right)
        difference = np.where(neighbor > 0, np.minimum(difference, abs(z - neighbor)), difference)
        covered += weight * (neighbor > 0)
        bilinear += weight[..., None] * I_B[top + i, left + j]
    visible = (d_A > 0) & (borders.min(0) >= 0) & (difference < THETA_Z) & (covered > 0.99)

    bicubic, whole = np.zeros((*z.shape, 3)), np.ones(z.shape, dtype=bool)
    for i, across in enumerate(cubic(down), -1):
        for j, along in enumerate(cubic(right), -1):
            row, column = (top + i).clip(0, maps.height - 1), (left + j).clip(0, maps.width - 1)
            whole &= (top + i == row) & (left + j == column) & (d_B[row, column] > 0)
            bicubic += (across * along)[..., None] * I_B[row, column]
    colors = np.where(whole[..., None], bicubic.clip(0, 255), bilinear)

    near = [abs(borders).min(0), abs(difference - THETA_Z), abs(covered - 0.99)]
    return colors, visible, float(np.min(near, where=d_A > 0, initial=1.0))


def example(of: AdversarialOptimizer, chosen: Choice) -> Example:
    maps, (width, height) = of.maps, of.crop
    a, b = int(chosen.source), int(chosen.auxiliary)
    rows, columns = np.mgrid[int(chosen.top) : int(chosen.top) + height, int(chosen.left) : int(chosen.left) + width]
    real, visible, margin = warped(maps, a, b, rows, columns)
    flat = rows * maps.width + columns
    uv = (maps.uv[a].double().numpy()[flat] + 32768) / 65535
    left, top = corner(uv[..., 0] * TEXTURE, TEXTURE), corner(uv[..., 1] * TEXTURE, TEXTURE)
    right = (uv[..., 0] * TEXTURE - 0.5 - left).clip(0, 1)
    down = (uv[..., 1] * TEXTURE - 0.5 - top).clip(0, 1)
    texels = top * TEXTURE + left
    return Example(
        condition=maps.color[a].double().numpy()[flat] / 127.5 - 1,
        real=real / 127.5 - 1,
        foreground=maps.depth[a].numpy()[flat] > 0,
        visible=visible,
        texels=np.stack((texels, texels + 1, texels + TEXTURE, texels + TEXTURE + 1), -1),
        weights=np.stack(((1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down), -1),
        margin=margin,
    )


def patch_counts(mask: Mask) -> tuple[Array, Array]:
    """Pixels of each logit's 70 x 70 receptive field that are in the mask, and those that are in the image."""
    height, width = mask.shape
    counts = np.zeros((2, height // 8 - 2, width // 8 - 2))
    for row, column in np.ndindex(*counts.shape[1:]):
        top, left = 8 * row - 23, 8 * column - 23
        field = mask[max(top, 0) : top + 70, max(left, 0) : left + 70]
        counts[:, row, column] = field.sum(), field.size
    return counts[0], counts[1]


def patches(shown: Example) -> tuple[Mask, Mask]:
    """Which logits count for the texture, and which of them for the discriminator."""
    foreground, pixels = patch_counts(shown.foreground)
    seen, _ = patch_counts(shown.visible)
    tie = (10 * foreground == pixels) | ((2 * seen == foreground) & (foreground > 0))
    assert not tie.any(), "rounding would decide"
    judged = ~(pixels - foreground > 0.9 * pixels)
    return judged, judged & (seen > 0.5 * foreground)


def judged_input(shown: Example, image: Tensor) -> Tensor:
    """[6,h,w]: the condition, and the residual of an image [h,w,3] where the auxiliary view sees."""
    condition, visible = torch.tensor(shown.condition), torch.tensor(shown.visible)[..., None]
    return torch.cat((condition, (image - condition) * visible), 2).permute(2, 0, 1)


def logits(parameters: list[Tensor], x: Tensor) -> Tensor:
    """[rows,columns] of an input: five 4 x 4 convolutions as sums over their taps, leaky ReLU between them."""
    for layer, stride in enumerate((2, 2, 2, 1, 1)):
        weight, bias = parameters[2 * layer : 2 * layer + 2]
        if layer:
            x = torch.where(x > 0, x, 0.2 * x)
        padded = torch.zeros(len(x), x.shape[1] + 2, x.shape[2] + 2, dtype=torch.float64)
        padded[:, 1:-1, 1:-1] = x
        down, right = (range(0, side + 2 - 3, stride) for side in x.shape[1:])
        x = bias[:, None, None].expand(-1, len(down), len(right))
        for i, j in np.ndindex(4, 4):
            under = padded[:, i : i + down.stop : stride, j : j + right.stop : stride]
            x = x + torch.einsum("oc,chw->ohw", weight[:, :, i, j], under)
    return x[0]


class Adam:
    """Kingma and Ba 2015, algorithm 1, with the paper's beta1; moves its tensors in place."""

    def __init__(self, parameters: list[Tensor], rate: float) -> None:
        self.parameters, self.rate, self.t = parameters, rate, 0
        self.moments = [(torch.zeros_like(each), torch.zeros_like(each)) for each in parameters]

    def step(self, gradients: list[Tensor]) -> None:
        self.t += 1
        for parameter, (m, v), g in zip(self.parameters, self.moments, gradients, strict=True):
            m.copy_(0.5 * m + 0.5 * g)
            v.copy_(0.999 * v + 0.001 * g**2)
            unbiased, spread = m / (1 - 0.5**self.t), v / (1 - 0.999**self.t)
            parameter.data -= self.rate * unbiased / (spread.sqrt() + 1e-8)


@dataclass(frozen=True)
class Played:
    """What one step found: `losses` are the discriminator's, the adversarial and L1."""

    real_logits: Tensor
    fake_logits: Tensor
    losses: tuple[float, float, float]
    of_texture: Tensor
    of_network: list[Tensor]

    @property
    def ahead(self) -> bool:
        return self.losses[0] <= self.losses[1]


class Twin:
    """The dense texture [H*W,3] and the discriminator's parameters, both float64, and how a step moves them."""

    def __init__(self, of: AdversarialOptimizer) -> None:
        self.texture = torch.zeros(TEXTURE * TEXTURE, 3, dtype=torch.float64)
        self.texture[of.maps.slot_map.flatten() >= 0] = of.values.detach().double()
        self.texture.requires_grad_()
        self.parameters = [parameter.detach().double().requires_grad_() for parameter in of.parameters]
        self.texture_adam, self.network_adam = Adam([self.texture], 1e-3), Adam(self.parameters, 1e-4)

    def follow(self, of: AdversarialOptimizer) -> None:
        """Takes over the texture and the parameters; the moments stay its own."""
        with torch.no_grad():
            self.texture[of.maps.slot_map.flatten() >= 0] = of.values.detach().double()
            for own, parameter in zip(self.parameters, of.parameters, strict=True):
                own.copy_(parameter)

    def render(self, shown: Example) -> Tensor:
        """[h,w,3] in [-1,1]."""
        texels, weights = torch.tensor(shown.texels), torch.tensor(shown.weights)
        return 2 * (self.texture[texels] * weights[..., None]).sum(2) - 1

    def play(self, shown: Example, index: int, l1_target: str) -> Played:
        source, real, fake = torch.tensor(shown.condition), torch.tensor(shown.real), self.render(shown)
        judged, learned = (torch.tensor(each) for each in patches(shown))
        of_real, of_fake = (logits(self.parameters, judged_input(shown, image)) for image in (real, fake))
        D_real, D_fake = of_real.sigmoid(), of_fake.sigmoid()
        L_c = D_real[learned].log().mean() + (1 - D_fake[learned]).log().mean()
        adversarial = -D_fake[judged].log().mean()
        target, seen = {"auxiliary": (real, shown.visible), "source": (source, shown.foreground)}[l1_target]
        L_L1 = (target - fake)[torch.tensor(seen)].abs().mean()
        objective = adversarial + 10 * 0.8 ** (index // 1000) * L_L1
        (of_texture,) = torch.autograd.grad(objective, [self.texture], retain_graph=True)
        of_network = torch.autograd.grad(-L_c, self.parameters)
        losses = (-L_c.item(), adversarial.item(), L_L1.item())
        return Played(of_real.detach(), of_fake.detach(), losses, of_texture, list(of_network))

    def move(self, played: Played) -> None:
        self.texture_adam.step([played.of_texture])
        if not played.ahead:
            self.network_adam.step(played.of_network)


def next_draw(of: AdversarialOptimizer) -> tuple[DrawnPair, Choice]:
    """What the next step is going to draw, and from where."""
    before = of.generator.get_state()
    batch = of.draw()
    of.generator.set_state(before)
    chosen = of.sampler.choose()
    of.generator.set_state(before)
    return batch, chosen


def shown_by(of: AdversarialOptimizer, batch: DrawnPair) -> Examples:
    """What the optimizer shows the discriminator of a batch."""
    fake = of.sampler.image(sample_texels(of.values.detach(), batch.slots, batch.weights)) * 2 - 1
    return assemble(batch.condition, batch.real, fake, batch.visible, None, of.form)


def difference(found: Tensor, expected: Tensor) -> float:
    """Euclidean, as a share of what is expected."""
    return float((found - expected).norm() / expected.norm())


def strayed(found: Tensor, expected: Tensor, rate: float) -> float:
    """The share of values that are farther from what is expected than a hundredth of one of Adam's steps."""
    return float(((found - expected).detach().abs() > 0.01 * rate).double().mean())


def test_examples_and_patches_are_the_papers() -> None:
    of = optimizer(fresh_network())
    twin = Twin(of)
    unseen, background, occluded = [], [], []
    for pair in PAIRS:
        batch, chosen = next_draw(of)
        of.draw()
        assert (int(chosen.source), int(chosen.auxiliary)) == pair
        shown = example(of, chosen)
        assert shown.margin > ROUNDING
        assert np.array_equal(batch.foreground[0, 0].numpy() == 1, shown.foreground)
        assert np.array_equal(batch.visible[0, 0].numpy() == 1, shown.visible)
        ours = shown_by(of, batch)
        for found, image in ((ours.real_input, torch.tensor(shown.real)), (ours.fake_input, twin.render(shown))):
            assert (found[0] - judged_input(shown, image)).abs().max() < 1e-5
        judged, learned = patches(shown)
        masks = patch_masks(batch.foreground, batch.visible)
        assert np.array_equal(masks.texture[0, 0].numpy() == 1, judged)
        assert np.array_equal(masks.discriminator[0, 0].numpy() == 1, learned)
        unseen.append((shown.foreground & ~shown.visible).sum())
        background.append((~judged).sum())
        occluded.append((judged & ~learned).sum())
    assert [bool(pixels > 0) for pixels in unseen] == [a != b for a, b in PAIRS]
    assert min(background) > 0, "the rule for the background decides somewhere"
    assert max(occluded) > 0, "the rule for what is occluded decides somewhere"


@pytest.mark.parametrize(
    ("make_network", "l1_target", "ahead"),
    [
        (fresh_network, "source", [False, False, False, False]),
        (decided_network, "auxiliary", [False, False, True, False]),
    ],
)
def test_steps_are_the_papers(
    make_network: Callable[[], PatchDiscriminator], l1_target: Literal["auxiliary", "source"], ahead: list[bool]
) -> None:
    """The twin takes each step from where the optimizer stands, with moments of its own.

    Rounding turns single ReLUs: that alone is a thousandth of the discriminator's gradient, else they differ by 1e-5.
    It turns single signs of Adam's as well; so Adam is also followed over all steps with the optimizer's gradients.
    """
    of = optimizer(make_network(), replace(PRINTED, l1_target=l1_target))
    twin, owned = Twin(of), of.maps.slot_map.flatten() >= 0
    values, parameters = of.values.detach().double(), [parameter.detach().double() for parameter in of.parameters]
    texture_adam, network_adam = Adam([values], 1e-3), Adam(parameters, 1e-4)
    for index, rests in enumerate(ahead, FIRST):
        twin.follow(of)
        batch, chosen = next_draw(of)
        played = twin.play(example(of, chosen), index, l1_target)
        with torch.no_grad():
            shown = shown_by(of, batch)
            for inputs, expected in ((shown.real_input, played.real_logits), (shown.fake_input, played.fake_logits)):
                assert (of.discriminator.examine(inputs)[0][0, 0] - expected).abs().max() < 5e-5
        of.step()
        losses = of.drain_losses()
        found = (losses["discriminator"], losses["adversarial"], losses["l1"])
        assert found == pytest.approx(played.losses, rel=0, abs=5e-6)
        assert (bool(losses["skipped"]), played.ahead) == (rests, rests)

        assert of.values.grad is not None
        assert difference(of.values.grad, played.of_texture[owned]) < 5e-3
        assert not played.of_texture[~owned].any()
        texture_adam.step([of.values.grad.double()])
        if not rests:
            gradients = [parameter.grad.double() for parameter in of.parameters if parameter.grad is not None]
            for gradient, exact in zip(gradients, played.of_network, strict=True):
                assert difference(gradient, exact) < 1e-2
            network_adam.step(gradients)
        twin.move(played)

        torch.testing.assert_close(of.values.detach().double(), values, atol=1e-8, rtol=1e-6)
        assert strayed(of.values, twin.texture[owned], 1e-3) < 1e-3
        for parameter, replayed, exact in zip(of.parameters, parameters, twin.parameters, strict=True):
            torch.testing.assert_close(parameter.detach().double(), replayed, atol=1e-8, rtol=1e-6)
            assert strayed(parameter, exact, 1e-4) < 1e-2
