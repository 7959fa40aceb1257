"""What target images show and no values of the unknowns can: a background that the scene has not, light that is too bright."""

import warnings

import numpy as np
from jaxtyping import Float

from jvr.fitting.bijectors import Identity, Softplus
from jvr.fitting.problem import Problem
from jvr.fitting.targets import Targets, written
from jvr.fitting.unknowns import ExposedModel, Unknowns
from jvr.model.optical import AbsorptionOnly, EmissionAbsorption
from jvr.model.transfer import AbstractTable
from jvr.pictures import srgb_from_linear

# What 8 bits cannot tell apart, as radiance or as an sRGB code.
STEP = 1 / 255
# By how much more than a scene can shine a target must be brighter: noise and filters overshoot.
BRIGHTER = 1.05
# Of a picture's height and width, the corner in which its background is looked for.
CORNER = 1 / 16


def known_background(model: ExposedModel, unknowns: Unknowns) -> Float[np.ndarray, "3"] | None:
    """What a target shows where there is nothing in front of it, `None` where that is to be found."""
    background = model.scene.background_colour
    if model.scene.ends_rays:
        return None
    if background is None:
        return np.zeros(3)
    scaled = model.exposure is not None and np.any(background)
    return None if scaled or unknowns.among(model, lambda m: m.scene.background) else np.asarray(background)


def say_what_is_out_of_reach(problem: Problem, targets: Targets) -> None:
    """Warns of a background that all targets show in their corners and the scene has not, and of light that no colours give."""
    behind = known_background(problem.model, problem.unknowns)
    for text in (None if behind is None else _other_background(behind, targets), _too_bright(problem, targets)):
        if text is not None:
            warnings.warn(text, stacklevel=3)


def _too_bright(problem: Problem, targets: Targets) -> str | None:
    highest = _brightest(problem)
    bright = np.concatenate([image[known].max(axis=-1) for image, known in zip(targets.images, targets.counted, strict=True)])
    if highest is None or not bright.max() > BRIGHTER * highest:
        return None
    return (
        f"{np.count_nonzero(bright > BRIGHTER * highest):,} pixels of the target images are brighter than the scene can be, up to "
        f"{bright.max():.3g}: without light its colours reach {highest:.3g} at most; exposure=True finds a factor for all images"
    )


def _brightest(problem: Problem) -> float | None:
    """The most that a pixel can have, `None` where nothing bounds it: a mean of colours of the table and the background."""
    scene, unknowns = problem.model.scene, problem.unknowns
    bounded = isinstance(scene.transfer, AbstractTable) and isinstance(scene.optical, EmissionAbsorption | AbsorptionOnly)
    bounded &= getattr(scene.transfer, "emission", None) is None
    if not bounded or scene.shows_light or scene.ends_rays or problem.model.exposure is not None:
        return None
    highest = 0.0
    for select in (lambda m: m.scene.transfer.rgb, lambda m: m.scene.background_colour):
        among = unknowns.among(problem.model, select)
        if any(isinstance(unknowns.bijectors[i], Identity | Softplus) for i in among):
            return None
        array = select(problem.model)
        highest = max(highest, 1.0 if among else 0.0, 0.0 if array is None else float(np.max(array)))
    return highest


def _other_background(behind: Float[np.ndarray, "3"], targets: Targets) -> str | None:
    """What the targets have in all their corners, or in the upper and in the lower ones, where that is not what is `behind`."""
    corners = [_corners(image, known) for image, known in zip(targets.images, targets.counted, strict=True)]
    above, below = (np.array([colour for pair in corners for colour in pair[k]]) for k in (0, 1))
    if not (len(above) and len(below)):
        return None
    top, bottom = np.median(above, axis=0), np.median(below, axis=0)
    if _differ(above, top) or _differ(below, bottom) or not (_differ(top, behind) and _differ(bottom, behind)):
        return None
    scene = f"that of the scene is {written(behind)}" if behind.any() else "the scene has none, which is black"
    if _differ(top, bottom):
        return (
            f"the target images seem to have a background from {written(top)} above to {written(bottom)} below, {scene}: render them over "
            "one colour, or give its pixels weight 0"
        )
    return f"the target images seem to have the background {written(top)}, linear, {scene}: give background={written(top)}"


def _corners(image: np.ndarray, known: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The middle colours of the upper two corners and of the lower two, of each that counts."""
    rows, columns = (max(1, round(CORNER * n)) for n in image.shape[:2])
    found: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for place, vertical in zip(found, (slice(rows), slice(-rows, None)), strict=True):
        for horizontal in (slice(columns), slice(-columns, None)):
            counted = image[vertical, horizontal][known[vertical, horizontal]]
            place += [np.median(counted, axis=0)] if len(counted) else []
    return found


def _differ(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether colours are told apart both as light and as codes: near black the steps of linear 8 bits are the coarser ones, near white
    those of sRGB."""
    codes = np.abs(srgb_from_linear(one) - srgb_from_linear(other))
    return bool(np.any((np.abs(one - other) > STEP) & (codes > STEP)))
