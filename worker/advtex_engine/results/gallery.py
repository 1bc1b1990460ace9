"""The pictures of a result, in its folder `previews/`.

comparison.png, sheet.png    photograph | textured render | projected mean of one view, and of a few
views/NNNN_photo.jpg, NNNN_render.jpg, NNNN_mean.jpg      the same of up to MAX_VIEWS views, at the same size
views/NNNN_seen.jpg          the render, with what no photograph shows in colors of its own (`seen.py`)
turntable/NN.jpg             the model from all around
turntable/NN_seen.jpg        the same in those colors
atlas_N.jpg, atlas_N_seen.jpg
                             the texture's pages
thumbnail.jpg                a good view of the model, square
photographs.json, .mjpeg     photographs with their cameras, see `photographs.py`
curves.json                  see `curves.py`
manifest.json                lists all but the first two and the stream; its paths are relative to the result's folder
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Scene, View, evenly_spread
from advtex_engine.previews.turntable import SIZE, Circle, circle_cameras, facing, find_circle
from advtex_engine.render.pictures import contact_sheet, encode_jpeg, side_by_side, to_bytes
from advtex_engine.render.render_view import GBuffer, gbuffer, renders_at_once, shade
from advtex_engine.results.initial_view import orbit
from advtex_engine.results.photographs import photograph_stream
from advtex_engine.results.seen import marks, tinted
from advtex_engine.runtime.files import write_atomically
from advtex_engine.runtime.threads import in_threads, one_thread_each

COMPARISON, SHEET = "comparison.png", "sheet.png"
MAX_VIEWS = 12
SHEET_VIEWS = 6
LONGEST_SIDE = 1280
ATLAS_SIDE = 2048
THUMBNAIL = 256
TURNTABLE_TEXTURE = 1024
"""Texels of the texture that pictures of the whole model are painted with: finer ones would flicker in them."""

Image = NDArray[np.uint8]
T = TypeVar("T")
R = TypeVar("R")


def write_gallery(
    out: Path,
    scene: Scene,
    atlas: Atlas,
    texture: Tensor,
    mean: Tensor,
    curves: Mapping[str, Any],
    state: Tensor | None = None,
) -> tuple[Path, ...]:
    """Writes all pictures below `out`/previews; -> their paths, the manifest last.

    texture, mean: [atlas.height,atlas.width,3] float sRGB in [0,1] on the device of the atlas's mesh, which renders.
    curves: see `curves.py`. state: [H,W] uint8 of `coverage`, for the pictures `_seen`; None: there are none of these.
    Pictures are rendered, encoded and written in a few threads.
    """
    threads = torch.get_num_threads() if texture.device.type == "cpu" else 1
    with one_thread_each():
        marked = None if state is None else marks(state)
        return _write_pictures(_Gallery(out, marked, threads), scene, atlas, texture, mean, curves)


def _write_pictures(
    gallery: _Gallery, scene: Scene, atlas: Atlas, texture: Tensor, mean: Tensor, curves: Mapping[str, Any]
) -> tuple[Path, ...]:
    renders = list[tuple[float, Image]]()
    gallery.save_all(_view_pictures(gallery, scene, atlas, texture, mean, renders))
    gallery.files += (gallery.folder / COMPARISON, gallery.folder / SHEET)
    circle = find_circle(atlas.mesh, scene.views, scene.up_axis)
    coarse = _coarse(texture)
    # Textures made of smaller pictures than the turntable's have no detail that finer samples would show.
    supersample = 2 if scene.views[0].camera.width >= SIZE[0] else 1

    def frame(numbered: tuple[int, Camera]) -> list[tuple[str, Image]]:
        number, camera = numbered
        buffer = gbuffer(facing(atlas, camera, circle.outer), camera, supersample)
        return list(gallery.both(f"turntable/{number:02d}", buffer, shade(buffer, coarse)))

    cameras = circle_cameras(circle)
    frames = gallery.rendered(frame, list(enumerate(cameras)), cameras)
    gallery.turntable = gallery.save_all(picture for pictures in frames for picture in pictures)
    atlases = gallery.save_all(_atlas_pictures(gallery, texture, atlas.pages))
    (thumbnail,) = gallery.save_all([("thumbnail.jpg", _thumbnail(atlas, circle, coarse, renders))])
    entries, stream = photograph_stream(scene, atlas, texture, gallery.threads)
    photographs = {"stream": gallery.write("photographs.mjpeg", stream), "views": entries}
    step = 1 if gallery.marked is None else 2
    manifest: dict[str, Any] = {
        "views": gallery.views,
        "turntable": gallery.turntable[::step],
        "orbit": orbit(circle, scene.up_axis),
        "thumbnail": thumbnail,
        "atlas": atlases[::step],
        "photographs": gallery.write("photographs.json", _json(photographs)),
        "curves": gallery.write("curves.json", _json(curves)),
    }
    if gallery.marked is not None:
        manifest |= {"turntable_seen": gallery.turntable[1::step], "atlas_seen": atlases[1::step]}
    gallery.write("manifest.json", _json(manifest))
    return tuple(gallery.files)


def chosen_views(scene: Scene) -> list[tuple[View, bool]]:
    """Up to MAX_VIEWS views from all over the capture, by name, and whether each was held out; of those up to half."""
    heldout = evenly_spread(scene.heldout, MAX_VIEWS // 2)
    training = evenly_spread(scene.views, MAX_VIEWS - len(heldout))
    chosen = [(view, True) for view in heldout] + [(view, False) for view in training]
    return sorted(chosen, key=lambda pair: pair[0].name)


class _Gallery:
    """The files written so far, and the manifest's lists.

    marked: a texture of `marks`, for a second picture of each that shows the model; None: there are none. threads: in
    which pictures are rendered.
    """

    def __init__(self, out: Path, marked: Tensor | None = None, threads: int = 1) -> None:
        self.out, self.marked, self.threads = out, marked, threads
        self.folder = out / "previews"
        self.files: list[Path] = []
        self.views: list[dict[str, Any]] = []
        self.turntable: list[str] = []

    def both(self, name: str, buffer: GBuffer, picture: Tensor) -> Iterator[tuple[str, Image]]:
        """A picture of the model, and the same with what no photograph shows."""
        yield f"{name}.jpg", to_bytes(picture)
        if self.marked is not None:
            yield f"{name}_seen.jpg", to_bytes(tinted(picture, shade(buffer, self.marked, background=0.0)))

    def rendered(self, function: Callable[[T], R], items: Iterable[T], cameras: Sequence[Camera]) -> Iterator[R]:
        """The function of each item, in order, as many at once as there is room for pictures of the cameras."""
        return in_threads(function, items, renders_at_once(cameras, self.threads))

    def save_all(self, pictures: Iterable[tuple[str, Image]]) -> list[str]:
        """Writes JPEGs. -> their paths as the manifest has them."""
        return [self._wrote(path) for path in in_threads(lambda picture: self._save(*picture), pictures)]

    def write(self, name: str, data: bytes) -> str:
        return self._wrote(self._put(name, data))

    def listed(self, name: str) -> str:
        """The path of a file as the manifest has it."""
        return (self.folder / name).relative_to(self.out).as_posix()

    def _save(self, name: str, picture: Image) -> Path:
        return self._put(name, encode_jpeg(picture))

    def _put(self, name: str, data: bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data)
        return path

    def _wrote(self, path: Path) -> str:
        self.files.append(path)
        return path.relative_to(self.out).as_posix()


def _view_pictures(
    gallery: _Gallery,
    scene: Scene,
    atlas: Atlas,
    texture: Tensor,
    mean: Tensor,
    renders: list[tuple[float, Image]],
) -> Iterator[tuple[str, Image]]:
    """Photograph, render and mean of the chosen views; then writes comparison.png and sheet.png.

    renders: takes, per view, the share of it that shows the model, and its render.
    """
    chosen = chosen_views(scene)
    shown = evenly_spread([view for view, heldout in chosen if heldout or not scene.heldout], SHEET_VIEWS)
    rows = list[list[Tensor]]()

    def pictured(view: View) -> tuple[float, list[Tensor], Tensor | None]:
        buffer = gbuffer(atlas, view.camera)
        pictures = [shade(buffer, candidate) for candidate in (texture, mean)]
        if gallery.marked is None:
            return buffer.coverage, pictures, None
        return buffer.coverage, pictures, tinted(pictures[0], shade(buffer, gallery.marked, background=0.0))

    views = [view for view, _ in chosen]
    found = gallery.rendered(pictured, views, [view.camera for view in views])
    for number, ((view, heldout), (coverage, pictures, seen)) in enumerate(zip(chosen, found, strict=True)):
        if any(view is other for other in shown):
            rows.append(pictures)
        images = [_reduced(image, LONGEST_SIDE) for image in (view.color.numpy(), *map(to_bytes, pictures))]
        height, width, _ = images[0].shape
        entry: dict[str, Any] = {"name": view.name, "heldout": heldout, "width": width, "height": height}
        for kind, image in zip(("photo", "render", "mean"), images, strict=True):
            name = f"views/{number:04d}_{kind}.jpg"
            entry[kind] = gallery.listed(name)
            yield name, image
        gallery.views.append(entry)
        renders.append((coverage, images[1]))
        if seen is not None:
            name = f"views/{number:04d}_seen.jpg"
            entry["seen"] = gallery.listed(name)
            yield name, _reduced(to_bytes(seen), LONGEST_SIDE)
    middle = len(shown) // 2
    rendered, averaged = rows[middle]
    gallery.folder.mkdir(parents=True, exist_ok=True)
    side_by_side(shown[middle], rendered, averaged, gallery.folder / COMPARISON)
    contact_sheet(shown, rows, ("advtex", "projected mean"), gallery.folder / SHEET)


def _thumbnail(atlas: Atlas, circle: Circle, coarse: Tensor, renders: Sequence[tuple[float, Image]]) -> Image:
    """The view of a room that shows most of it and has most to show, else the model from the scan's side."""
    if not circle.inside:
        camera = circle_cameras(circle, (THUMBNAIL, THUMBNAIL))[0]
        return to_bytes(shade(gbuffer(facing(atlas, camera, circle.outer), camera), coarse))
    _, best = max(renders, key=lambda render: render[0] * float(render[1].std()))
    return _square(best)


def _square(image: Image) -> Image:
    """The middle of it, THUMBNAIL pixels a side."""
    side = min(image.shape[:2])
    top, left = ((length - side) // 2 for length in image.shape[:2])
    middle = image[top : top + side, left : left + side]
    return np.asarray(cv2.resize(middle, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA), np.uint8)


def _coarse(texture: Tensor) -> Tensor:
    """The texture averaged over blocks until it has about TURNTABLE_TEXTURE texels a side."""
    return torch.from_numpy(_reduced(texture.cpu().numpy(), TURNTABLE_TEXTURE)).to(texture.device)


def _atlas_pictures(gallery: _Gallery, texture: Tensor, count: int) -> Iterator[tuple[str, Image]]:
    marked = None if gallery.marked is None else _page_tensors(gallery.marked, count)
    for number, page in enumerate(_pages(texture, count)):
        yield f"atlas_{number}.jpg", page
        if marked is not None:
            size = (page.shape[1], page.shape[0])
            area = cv2.resize(next(marked).cpu().numpy(), size, interpolation=cv2.INTER_AREA)
            yield (
                f"atlas_{number}_seen.jpg",
                to_bytes(tinted(torch.from_numpy(page).float() / 255, torch.from_numpy(area))),
            )


def _pages(texture: Tensor, count: int) -> Iterator[Image]:
    for page in _page_tensors(texture, count):
        # Made smaller first: a page's bytes and their temporaries would take as much memory as the texture.
        yield to_bytes(torch.from_numpy(_reduced(page.cpu().numpy(), ATLAS_SIDE)))


def _page_tensors(texture: Tensor, count: int) -> Iterator[Tensor]:
    height, width = texture.shape[0] // count, texture.shape[1] // count
    for row in range(count):
        for column in range(count):
            yield texture[row * height : (row + 1) * height, column * width : (column + 1) * width]


def _reduced(pixels: NDArray[Any], longest: int) -> NDArray[Any]:
    """The pixels themselves, or averaged to fewer where a side is longer than `longest`."""
    height, width, _ = pixels.shape
    scale = longest / max(height, width)
    if scale >= 1:
        return pixels
    return cv2.resize(
        pixels, (max(1, round(width * scale)), max(1, round(height * scale))), interpolation=cv2.INTER_AREA
    )


def _json(value: object) -> bytes:
    return json.dumps(value, allow_nan=False).encode() + b"\n"
