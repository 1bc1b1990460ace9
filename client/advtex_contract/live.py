"""A running job's texture as it is now: what the engine shows, the worker stores and the API tells."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Series = Annotated[dict[str, list[float | None]], Field(max_length=20)]


class CurveSet(BaseModel):
    """Values by name, one per step; null where there is none."""

    steps: list[int] = Field(default_factory=list, max_length=1000)
    series: Series = Field(default_factory=dict)


class Curves(CurveSet):
    """Losses, what the discriminator knows, and quality as measured now and then on a few fixed views.

    `accuracy`: share of patches that the discriminator tells apart; `accuracy_real`, `accuracy_fake`: of the real and
    of the fake ones. `margin`, `spread`: of its logits. `gradient_…`: norms, now and then, of what each term adds to
    the texture's gradient. Quality: `psnr` in dB, `gradient_ratio` of the photographs' gradients.
    """

    quality: CurveSet = CurveSet()


class LivePicture(BaseModel):
    """A small JPEG of the model; `view` is the name of the frame that it compares with."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    name: str = Field(pattern=r"^[0-9A-Za-z_-]{1,40}\.jpg$")
    view: str = Field(max_length=1000)
    jpeg: bytes = Field(max_length=150_000)


class LiveRecord(BaseModel):
    """A look at a running job, as its worker stores it."""

    step: int
    curves: Curves
    pictures: list[LivePicture] = Field(max_length=4)


class LiveImage(BaseModel):
    """A picture of a `LiveView` and the path on the same server where it is."""

    name: str
    view: str
    href: str


class LiveView(BaseModel):
    """A running job's texture after `step`, renewed every few seconds; empty where there is nothing to see yet, and
    once the job has its results."""

    step: int = 0
    curves: Curves = Curves()
    images: list[LiveImage] = Field(default_factory=list)
