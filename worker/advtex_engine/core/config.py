"""Every number of the method, named once.

Preset      the paper's symbols beside ours: steps, start, lr_texture, lr_discriminator, l1_weight (lambda), l1_decay
TextureConfig   what one run is asked to do
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from advtex_engine.core.errors import OptionError
from advtex_options import Options, described, refusal
from advtex_options.methods import chosen_method, known_methods
from advtex_options.options import FACE_BUDGET, MAX_VIEWS


@dataclass(frozen=True)
class PyramidLevel:
    """`steps` at 1/scale of the working size and of the texture's size."""

    steps: int
    scale: int = 1


@dataclass(frozen=True)
class Preset:
    """Hyper-parameters of the optimization (paper sections 3.2 and 4; supplement "Training").

    levels            coarse-to-fine schedule; one level for everything but `preview`
    start             "zero" (black, as printed), "mean" (the projected mean) or "selection" (one view per face)
    passes            over all pixels of the views, in which a start of "selection" is brought nearer to their Gabor
                      energies before the game (`methods/gabor.py`; paper: 0)
    toned             the views' wide averages are made the start's (paper: views as photographed)
    pretraining       first steps, counted in `levels`, in which the discriminator learns alone
    lr_texture        1e-3, Adam; colors in [0, 1]. Adam's step is as long however rarely a view shows the texel and
                      however faint its gradient is: it is noise that accumulates while nothing holds it back
    lr_unit           of lr_texture: "color" (1, as the paper's) or "disagreement", the root of the mean absolute
                      difference of the views to the start
    lr_discriminator  1e-4, Adam
    lr_follows        power of lambda's decay by which the texture's rate falls (paper: 0, not at all)
    lr_end            share of both at the last step, reached in a straight line (paper: 1, no decay)
    beta1             0.5
    l1_weight         lambda = 10 at the start
    l1_target         "auxiliary" (the warped auxiliary image, where that view sees: the paper's text), "source" (the
                      source image, wherever it shows the mesh: its supplement A) or "start" (the start's own render)
    l1_decay          lambda is multiplied by this `l1_decays` times over the run (paper: 0.8 every 1,000 of 50,000)
    feature_weight    of the distance between what the discriminator's layers respond to the render and to the real
                      example (paper: 0); tolerant to shifts as they are, it averages less than L1 does
    gabor_weight      of the distance between the Gabor energies of the render and of the source image (paper: 0); it
                      forgives displacements of some pixels, so it does not blur where views disagree
    averaging         steps over which the resulting texture is averaged (as printed: none, the last state)
    alignment         both examples are moved onto the source image before they are judged (Zhao et al. 2022)
    perturbation      of the view's width, by which virtual motions of the auxiliary camera shift its image at most
                      (paper: 0; its supplement D proposes them for sparse views)
    areas             the render's pixels are means over what they show, where the photographs' are; else values at
                      their middles (paper; released code)
    max_crop          largest crop (width, height) in pixels; larger views are seen in parts, for cheaper steps
    descent_crop      the same of the passes before the game, which need 1.2 KB a pixel
    max_pair_angle    largest angle between the optical axes of a pair, degrees (released code: 15)
    min_pair_overlap  least share of the source's foreground that the auxiliary view sees
    nearest_share     of the views that remain for a source, rounded up, those whose warped images differ least from it
    turn              steps, after pretraining, for which some views are left out of the game, and then judge it; only
                      from a start of "selection" (paper: 0, never)
    patience          turns in a row that bring nothing, after which it ends; the best state is kept. With pretraining
                      they are less than a fifth of the steps, all that a game costs that cannot help
    auxiliary         real examples are warped auxiliary views; else the source itself (ablation, paper section 4)
    condition         the discriminator is shown the source image; else the example alone (ablation, paper section 4)
    """

    levels: tuple[PyramidLevel, ...]
    start: Literal["zero", "mean", "selection"]
    passes: float = 0.0
    toned: bool = False
    pretraining: int = 0
    lr_texture: float = 1e-3
    lr_unit: Literal["color", "disagreement"] = "color"
    lr_discriminator: float = 1e-4
    lr_follows: float = 0.0
    lr_end: float = 1.0
    beta1: float = 0.5
    l1_weight: float = 10.0
    l1_target: Literal["auxiliary", "source", "start"] = "auxiliary"
    l1_decay: float = 0.8
    l1_decays: float = 50.0
    feature_weight: float = 0.0
    gabor_weight: float = 0.0
    averaging: int = 0
    alignment: bool = False
    perturbation: float = 0.0
    areas: bool = False
    max_crop: tuple[int, int] | None = None
    descent_crop: tuple[int, int] = (640, 480)
    max_pair_angle: float = 15.0
    min_pair_overlap: float = 0.3
    nearest_share: float = 1.0
    turn: int = 0
    patience: int = 2
    auxiliary: bool = True
    condition: bool = True

    @property
    def steps(self) -> int:
        """Optimiser iterations over all levels."""
        return sum(level.steps for level in self.levels)


PRINTED = Preset(levels=(PyramidLevel(50_000),), start="zero")
"""The paper's recipe to the letter (section 3.2). In 3D it speckles: `PAPER` says what is chosen otherwise, and why."""

# What the paper leaves open; `tests/benchmarks/paper.py --rows suspects` tries each choice by itself.
PAPER = replace(
    PRINTED,
    # Black is far from any texture, and a texel that a tenth of the views show takes 2,000 steps to get away from it;
    # the discriminator meets nothing but unfinished textures meanwhile.
    start="mean",
    # Frames differ in exposure, and a texture has but one tone. Where a render is told from the real example by its
    # tone, the texture can give no answer: on a kitchen it ended at 1.57 times the LPIPS of the texture of least L1
    # distance, and at .79 times that with views in one tone.
    toned=True,
    # In the paper's case of two dimensions every step shows every texel. Here a view shows a tenth of them: Adam's
    # moments, means over all steps, make a step about 1 / sqrt(.1) times the rate for each time that the texel is seen.
    # How far a texel has to go depends on how far the views disagree, by .03 on a kitchen and by .13 on an object of
    # strong colors with wrong cameras, where a rate for kitchens ends half way; what the noise of the steps costs does
    # not. A rate in proportion speckles where they disagree, an even one blurs: the root lies between.
    lr_texture=4.2e-4,
    lr_unit="disagreement",
    # Steps pay while lambda holds them together. Later noise adds up, and the texture drifts from the photographs to
    # all that the discriminator has not learned to tell from them.
    lr_follows=0.5,
    # The warped auxiliary image is displaced by the errors of two cameras, the source by those of one.
    l1_target="source",
    # A texture that cannot be told from the real examples is as far from the photographs as they are: on two kitchens
    # those of all pairs have 1.13 and .77 times the LPIPS of the texture of least L1 distance, those of the better half
    # .77 and .59 times (`tests/benchmarks/examples.py`).
    nearest_share=0.5,
)
# From a sharp start the paper's weights blur: the L1 term only holds on to the start, features are matched, and the
# discriminator has been trained before the texture listens to it.
STANDARD = Preset(
    levels=(PyramidLevel(750),),
    start="selection",
    passes=5,
    toned=True,
    pretraining=75,
    # Twice the steps at half of it take .4 % more off the LPIPS of five scans (corrected, nothing).
    lr_texture=8e-4,
    lr_discriminator=8e-4,
    lr_end=0.05,
    l1_weight=1.0,
    l1_target="start",
    l1_decays=0,
    feature_weight=10.0,
    gabor_weight=5.0,
    averaging=500,
    turn=30,
    alignment=True,
    areas=True,
    max_crop=(384, 288),
)
PRESETS: dict[str, Preset] = {
    "paper": PAPER,
    "full": replace(
        STANDARD,
        levels=(PyramidLevel(50_000),),
        # The same way in smaller steps: a discriminator that has gone further than standard's spoils the texture.
        pretraining=5_000,
        lr_texture=1.6e-5,
        lr_discriminator=3.2e-5,
        averaging=12_000,
        turn=2_000,
        max_crop=None,
    ),
    "standard": STANDARD,
    "preview": replace(
        STANDARD,
        levels=(PyramidLevel(800, scale=2), PyramidLevel(300)),
        passes=0,
        pretraining=120,
        lr_texture=4e-4,
        averaging=100,
        turn=40,
    ),
}


@dataclass(frozen=True)
class TextureConfig(Options):
    """What one run is asked to do: the user's options, and what is the machine's or the engine's own.

    preset            a name of PRESETS; "auto" is standard where a game is played
    method            its name, also where none is asked for
    size              working size (width, height) of the views in pixels; None keeps the scan's
    max_views         of a longer scan, these many frames are chosen; fewer where their maps would not fit into memory
    memory_bytes      what the run may take of a GPU that others use too; None: all that is free
    refine            cameras, exposures and vertices are refined first; never for the preset "paper", which does not
    """

    method: str = ""
    face_budget: int = FACE_BUDGET
    max_views: int = MAX_VIEWS
    lossless: bool = False
    size: tuple[int, int] | None = None
    texels_per_pixel: float = 1.2
    refine: bool = True
    device: str = "auto"
    checkpoint_seconds: float = 30.0
    memory_bytes: int | None = None

    @property
    def refines(self) -> bool:
        """Whether cameras and exposures are refined first; some methods are nothing without."""
        return known_methods()[self.method].refines_cameras or (self.refine and self.preset != "paper")

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", chosen_method(self.method, self.preset))
        for name in described():
            value = getattr(self, name)
            if value is not None and (words := refusal(name, value)) is not None:
                raise OptionError(words)


def resolve_preset(config: TextureConfig) -> Preset:
    """The preset's numbers, the steps overridden where asked.

    From a sharp start more steps than the preset's take smaller ones: further on the texture fits what is blurred in
    the photographs. The paper's steps are as long as they are.
    """
    preset = PRESETS["standard" if config.preset == "auto" else config.preset]
    if config.steps is None:
        return preset
    share = config.steps / preset.steps
    levels = [PyramidLevel(round(level.steps * share), level.scale) for level in preset.levels]
    levels[-1] = PyramidLevel(config.steps - sum(level.steps for level in levels[:-1]), levels[-1].scale)
    pretraining, averaging, turn = (int(n * share) for n in (preset.pretraining, preset.averaging, preset.turn))
    passes = preset.passes * min(1, share)
    preset = replace(
        preset, levels=tuple(levels), passes=passes, pretraining=pretraining, averaging=averaging, turn=turn
    )
    if preset.start != "selection" or share <= 1:
        return preset
    return replace(preset, lr_texture=preset.lr_texture / share, lr_discriminator=preset.lr_discriminator / share)
