"""Features of pretrained networks, and LPIPS: how different two images look to one.

Convolutions of AlexNet and VGG16 in plain torch, with weights that a user gives or has downloaded: torchvision's
files (`alexnet-owt-7be5be79.pth`, `vgg16-397923af.pth`; the `features.*` of them are enough), and the linear heads of
LPIPS v0.1 (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"; `alex.pth`,
`vgg.pth`).
"""

from __future__ import annotations

import hashlib
import os
import urllib.request
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advtex_engine.core.errors import EngineError
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.runtime.files import atomic_file

WEIGHTS_VARIABLE = "ADVTEX_LPIPS_WEIGHTS"
IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DOWNLOAD_SECONDS = 30.0
"""Longest wait for the next bytes of a download."""
DOWNLOAD_BLOCK = 1 << 20


class WeightsError(EngineError):
    """Weights are missing, broken or cannot be downloaded."""


@dataclass(frozen=True)
class Conv:
    """A 2D convolution followed by ReLU: its number in torchvision's `features`, shape and stride.

    pool: side of the max-pooling window (stride 2) before it, 0 for none. tap: whether its output is a feature.
    """

    number: int
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = True


NETWORKS: dict[str, tuple[Conv, ...]] = {
    "alexnet": (
        Conv(0, 3, 64, kernel=11, stride=4, padding=2),
        Conv(3, 64, 192, kernel=5, padding=2, pool=3),
        Conv(6, 192, 384, pool=3),
        Conv(8, 384, 256),
        Conv(10, 256, 256),
    ),
    "vgg16": (
        Conv(0, 3, 64, tap=False),
        Conv(2, 64, 64),
        Conv(5, 64, 128, pool=2, tap=False),
        Conv(7, 128, 128),
        Conv(10, 128, 256, pool=2, tap=False),
        Conv(12, 256, 256, tap=False),
        Conv(14, 256, 256),
        Conv(17, 256, 512, pool=2, tap=False),
        Conv(19, 512, 512, tap=False),
        Conv(21, 512, 512),
        Conv(24, 512, 512, pool=2, tap=False),
        Conv(26, 512, 512, tap=False),
        Conv(28, 512, 512),
    ),
}
# Names under which the files are published or passed on, tried in order.
FILE_NAMES = {
    "alexnet": ("alexnet-owt-*.pth", "alexnet_features*.pth"),
    "vgg16": ("vgg16-*.pth", "vgg16_features*.pth"),
    "lpips_alexnet": ("alex.pth", "v0.1/alex.pth", "lpips_lin_alex*.pth"),
    "lpips_vgg16": ("vgg.pth", "v0.1/vgg.pth", "lpips_lin_vgg*.pth"),
}


@dataclass(frozen=True)
class Source:
    """A file to download, and its SHA-256."""

    name: str
    url: str
    sha256: str


LPIPS_SOURCES = (
    Source(
        "alexnet-owt-7be5be79.pth",
        "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
        "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
    ),
    Source(
        "alex.pth",
        "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
)


class FeatureStack(nn.Module):
    """The convolutions of a pretrained network, without its classifier; frozen, differentiable in the images."""

    def __init__(self, network: str, state: dict[str, Tensor]) -> None:
        """state: `features.N.weight` and `.bias` as torchvision names them; other entries are ignored.

        Raises WeightsError when an entry is missing or has another shape.
        """
        super().__init__()
        self.layers = NETWORKS[network]
        for layer in self.layers:
            shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
            for part, wanted in (("weight", shape), ("bias", shape[:1])):
                name = f"features.{layer.number}.{part}"
                self.register_buffer(f"{part}_{layer.number}", _entry(state, name, wanted))
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("deviation", torch.tensor(IMAGENET_DEVIATION).view(1, 3, 1, 1))

    def forward(self, images: Tensor) -> list[Tensor]:
        """[N,3,H,W] sRGB in [0,1] -> features [N,C,h,w] after the ReLU of each tapped layer.

        AlexNet: relu1 to relu5. VGG16: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3.
        """
        assert images.ndim == 4 and images.shape[1] == 3
        features = []
        values = (images - self.get_buffer("mean")) / self.get_buffer("deviation")
        for layer in self.layers:
            if layer.pool:
                values = F.max_pool2d(values, layer.pool, 2)
            weight, bias = (self.get_buffer(f"{part}_{layer.number}") for part in ("weight", "bias"))
            values = F.relu(F.conv2d(values, weight, bias, layer.stride, layer.padding))
            if layer.tap:
                features.append(values)
        return features


class Lpips:
    """LPIPS v0.1, on AlexNet as it is meant to be used, or on VGG16."""

    def __init__(self, stack: FeatureStack, heads: Sequence[Tensor]) -> None:
        """heads: per feature the weights [C] of its channels."""
        self.stack = stack
        self.heads = [head.view(1, -1, 1, 1) for head in heads]

    def to(self, device: torch.device) -> Lpips:
        """The same on another device."""
        return Lpips(self.stack.to(device), [head.to(device) for head in self.heads])

    @torch.no_grad()
    def maps(self, images: Tensor, truths: Tensor) -> Tensor:
        """Pairs of images [N,3,H,W] sRGB in [0,1] -> the maps [N,H,W] of `__call__`."""
        assert images.shape == truths.shape and images.shape[1] == 3
        size, count = images.shape[-2:], len(images)
        whole = images.new_zeros((count, 1, *size))
        for features, head in zip(self.stack(torch.cat((images, truths))), self.heads, strict=True):
            layer = unlike(features[:count], features[count:], head)
            whole += F.interpolate(layer, size, mode="bilinear", align_corners=False)
        return whole[:, 0]

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> tuple[float, Tensor]:
        """Two images [H,W,3] sRGB in [0,1] -> the distance as published, and its map [H,W].

        Per layer: features scaled to unit length per pixel, squared differences weighted by the heads. The distance is
        the sum over layers of the spatial means; the map is the sum of the layers' maps, enlarged bilinearly.
        """
        assert image.shape == truth.shape
        return self._compared(image, self._features(truth))

    @torch.no_grad()
    def masked(self, image: Tensor, truth: Photograph) -> float:
        """Mean of the map over the mask; what lies outside the mask is context, the same in both images."""
        composed = torch.where(truth.mask[..., None], image, truth.color)
        return float(self._compared(composed, truth.once(self._features))[1][truth.mask].mean())

    @torch.no_grad()
    def on_black(self, image: Tensor, truth: Photograph) -> float:
        """The distance as published with both images black outside the mask; the black part is averaged in."""
        return self._compared(image * truth.mask[..., None], truth.once(self._features_on_black))[0]

    def _features(self, image: Tensor, _: Tensor | None = None) -> list[Tensor]:
        """Of an image [H,W,3] sRGB in [0,1], [1,C,h,w] per layer."""
        assert image.ndim == 3 and image.shape[2] == 3
        found: list[Tensor] = self.stack(image.to(torch.float32).permute(2, 0, 1)[None])
        return found

    def _features_on_black(self, image: Tensor, mask: Tensor) -> list[Tensor]:
        return self._features(image * mask[..., None])

    def _compared(self, image: Tensor, truths: Sequence[Tensor]) -> tuple[float, Tensor]:
        """Distance and map of an image from the truth whose features are given."""
        size = image.shape[:2]
        total, whole = 0.0, torch.zeros(size, device=image.device)
        for ours, theirs, head in zip(self._features(image), truths, self.heads, strict=True):
            layer = unlike(ours, theirs, head)
            total += float(layer.mean())
            whole += F.interpolate(layer, size, mode="bilinear", align_corners=False)[0, 0]
        return total, whole


def unlike(features: Tensor, truths: Tensor, head: Tensor) -> Tensor:
    """[N,C,h,w] each -> [N,1,h,w]: squared differences of features of unit length, weighted by the head [1,C,1,1]."""
    units = [each / (each.square().sum(1, keepdim=True).sqrt() + 1e-10) for each in (features, truths)]
    return ((units[0] - units[1]).square() * head).sum(1, keepdim=True)


def load_lpips(folder: Path | None = None, network: str = "alexnet") -> Lpips:
    """LPIPS with the weights of `weights_folder(folder)`. Raises WeightsError that names what is missing."""
    stack = load_features(network, folder)
    state = _load(_find(f"lpips_{network}", weights_folder(folder)))
    channels = [layer.outputs for layer in NETWORKS[network] if layer.tap]
    heads = [_entry(state, f"lin{index}.model.1.weight", (1, count, 1, 1)) for index, count in enumerate(channels)]
    return Lpips(stack, heads)


def load_features(network: str, folder: Path | None = None) -> FeatureStack:
    """The pretrained network ("alexnet" or "vgg16") from `weights_folder(folder)`. Raises WeightsError."""
    path = _find(network, weights_folder(folder))
    try:
        return FeatureStack(network, _load(path))
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error


def weights_folder(folder: Path | None = None) -> Path:
    """Where weights are read from: `folder`, else $ADVTEX_LPIPS_WEIGHTS, else the cache that downloads go to."""
    if folder is not None:
        return folder
    import platformdirs  # here, so that the bench runs where nothing but torch is installed

    configured = os.environ.get(WEIGHTS_VARIABLE)
    return Path(configured) if configured else platformdirs.user_cache_path("advtex") / "weights"


def download(sources: Iterable[Source], folder: Path) -> None:
    """Fetch what `folder` lacks; a file is there whole and with the right checksum, or not at all.

    Raises WeightsError when the host cannot be reached or sends something else.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for source in sources:
        target = folder / source.name
        if target.exists() and _sha256(target) == source.sha256:
            continue
        try:
            _fetch(source, target)
        except OSError as error:
            raise WeightsError(
                f"{source.url} cannot be downloaded ({error}); fetch it elsewhere and put it into {folder}"
            ) from error


def _fetch(source: Source, target: Path) -> None:
    digest = hashlib.sha256()
    # The addresses are constants of this module.
    with (
        urllib.request.urlopen(source.url, timeout=DOWNLOAD_SECONDS) as response,  # noqa: S310
        atomic_file(target) as file,
    ):
        while block := response.read(DOWNLOAD_BLOCK):
            digest.update(block)
            file.write(block)
        if digest.hexdigest() != source.sha256:
            raise WeightsError(f"{source.url} sent a file with another checksum; it is not used")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _find(what: str, folder: Path) -> Path:
    for name in FILE_NAMES[what]:
        found = sorted(folder.glob(name))
        if found:
            return found[0]
    names = " or ".join(FILE_NAMES[what])
    raise WeightsError(f"no weights: {folder} has no file {names}; set {WEIGHTS_VARIABLE}, or download them once")


def _load(path: Path) -> dict[str, Tensor]:
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the unpickler meets in a broken file
        raise WeightsError(f"{path} is not a file of weights ({type(error).__name__})") from error
    if not isinstance(state, dict):
        raise WeightsError(f"{path} is not a table of weights")
    return state


def _entry(state: dict[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    value = state.get(name)
    if not isinstance(value, Tensor) or tuple(value.shape) != shape:
        found = "nothing" if not isinstance(value, Tensor) else f"shape {tuple(value.shape)}"
        raise WeightsError(f"entry {name} has {found} where shape {shape} is needed")
    return value.to(torch.float32)
