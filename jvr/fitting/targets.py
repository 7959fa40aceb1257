"""Target images as a fit takes them: which pixels count, and what is behind their alpha."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jvr.model.camera import AbstractCamera
from jvr.pictures import as_radiance


class Targets(NamedTuple):
    """Finite images `(height, width, 3)` and a weight for each pixel, `None` where all count alike."""

    images: list[np.ndarray]
    weights: list[np.ndarray] | None

    @property
    def counted(self) -> list[np.ndarray]:
        """Which pixels of each image count."""
        return (
            [np.ones(image.shape[:2], bool) for image in self.images] if self.weights is None else [w > 0 for w in self.weights]
        )

    @property
    def are_weighted(self) -> bool:
        """Whether some pixels count more than others."""
        return self.weights is not None and len(np.unique(np.concatenate([np.unique(weight) for weight in self.weights]))) > 1

    def marked(self) -> list[np.ndarray]:
        """The images with NaN for pixels that do not count."""
        return [np.where(known[..., None], image, np.nan) for image, known in zip(self.images, self.counted, strict=True)]


def check_cameras(cameras: Any, name: str = "cameras") -> None:
    """**Raises** `TypeError` for what is no sequence of cameras; a single camera is told apart where its image is known."""
    if isinstance(cameras, AbstractCamera):
        return
    if not isinstance(cameras, Sequence):
        raise TypeError(f"{name} must be a list or tuple of jvr's cameras, such as jvr.orbit(...), not {type(cameras).__name__}")
    wrong = next((camera for camera in cameras if not isinstance(camera, AbstractCamera)), None)
    if wrong is not None:
        raise TypeError(f"{name} must hold jvr's cameras, such as jvr.PerspectiveCamera.look_at(...), not {wrong!r:.60}")


def check_images(cameras: Sequence[AbstractCamera], images: Any, name: str = "target image") -> list[np.ndarray]:
    """The images as float arrays, one for each camera and of its size.

    **Raises** `ValueError` where their number or a size differs, a pixel is not finite, or they hold codes in place of radiance.
    """
    arrays = _arrays(cameras, images, name)
    for i, image in enumerate(arrays):
        if image.shape[-1] == 4:
            raise ValueError(f"{name} {i} has four channels: give light over the scene's background, (height, width, 3)")
        if not np.all(np.isfinite(image)):
            raise ValueError(
                f"{name} {i} has {np.sum(~np.isfinite(image))} values that are not finite: replace them (jvr.fit takes them with weight 0)"
            )
    _say_what_no_scene_gives(arrays, name)
    return arrays


def targets_of(
    cameras: Sequence[AbstractCamera],
    images: Any,
    weights: Sequence[Any] | None,
    behind: Float[np.ndarray, "3"] | None,
    name: str = "target image",
) -> Targets:
    """The images of a fit, one for each camera and of its size.

    - Pixels that are not finite have weight 0, which is said where they had another.
    - Of images with an alpha, `(height, width, 4)`, the colours are light over black, as in `jvr.Rendering`; `behind`, `(3,)`, is added to
      them where they are transparent, which is said. An alpha is no weight: that there is nothing in front of the background is what a fit
      learns there.

    **Raises** `ValueError` where their number or a size differs, an image has no pixel that counts, they hold codes in place of radiance,
    an alpha lies outside of 0 ... 1, or what is behind it is not known (`None`).
    """
    arrays = _arrays(cameras, images, name)
    counted = check_weights(cameras, weights, arrays[0].dtype)
    finite = [np.all(np.isfinite(image), axis=-1) for image in arrays]
    if not all(np.all(known) for known in finite):
        weights = counted = _without_unknown(counted, finite, name)
        arrays = [np.where(known[..., None], image, 0) for image, known in zip(arrays, finite, strict=True)]
    if not any(weight.any() for weight in counted):
        raise ValueError(f"no pixel of a {name} counts, all weights are 0: give some of them a positive one")
    arrays = _over(behind, arrays, name)
    _say_what_no_scene_gives([image[weight > 0] for image, weight in zip(arrays, counted, strict=True)], name)
    return Targets(arrays, None if weights is None else counted)


def check_weights(cameras: Sequence[AbstractCamera], weights: Sequence[Any] | None, dtype: Any) -> list[np.ndarray]:
    """A weight for each pixel of each camera, 1 without any.

    **Raises** `ValueError` where their number or a size differs, or one is negative or not finite.
    """
    if weights is None:
        return [np.ones((camera.height, camera.width), dtype) for camera in cameras]
    arrays = [np.asarray(weight, dtype) for weight in weights]
    if len(arrays) != len(cameras):
        raise ValueError(f"there are weights for {len(arrays)} images and {len(cameras)} cameras: give one array for each")
    for i, (camera, weight) in enumerate(zip(cameras, arrays, strict=True)):
        if weight.shape != (camera.height, camera.width) or not np.all(np.isfinite(weight) & (weight >= 0)):
            raise ValueError(
                f"weights {i} must be {(camera.height, camera.width)}, finite and not negative; they have shape {weight.shape}"
            )
    return arrays


def _arrays(cameras: Sequence[AbstractCamera], images: Any, name: str) -> list[np.ndarray]:
    """The images with three or four channels, which hold no codes as far as that can be told."""
    if isinstance(cameras, AbstractCamera) or getattr(images, "ndim", 4) == 3:
        raise TypeError("cameras and images must be sequences of as many: put a single one in brackets, as [camera] and [image]")
    check_cameras(cameras)
    if not hasattr(images, "__iter__"):
        raise TypeError(
            f"{name}s must be a sequence of arrays (height, width, 3), one for each camera, not {type(images).__name__}"
        )
    arrays = [as_radiance(image, f"{name} {i}").astype(jnp.result_type(float)) for i, image in enumerate(images)]
    if len(arrays) != len(cameras) or not arrays:
        raise ValueError(
            f"there are {len(arrays)} images for {len(cameras)} cameras: give one image for each camera, and at least one"
        )
    for i, (camera, image) in enumerate(zip(cameras, arrays, strict=True)):
        if image.shape not in ((camera.height, camera.width, 3), (camera.height, camera.width, 4)):
            raise ValueError(
                f"{name} {i} has shape {image.shape}, its camera sees {(camera.height, camera.width, 3)}: resize the image or the camera"
            )
        known = image[np.isfinite(image)]
        # A photograph that was only converted to floating point.
        if known.size and known.max() >= 16 and np.array_equal(known, np.rint(known)):
            raise ValueError(
                f"{name} {i} holds whole numbers up to {known.max():g}, radiance has white at 1: "
                "convert codes by jvr.linear_from_srgb(codes / 255)"
            )
    return arrays


def _without_unknown(weights: list[np.ndarray], finite: list[np.ndarray], name: str) -> list[np.ndarray]:
    """The weights with 0 for pixels that are not finite."""
    lost = [np.count_nonzero(~known & (weight > 0)) for weight, known in zip(weights, finite, strict=True)]
    found = [np.where(known, weight, 0) for weight, known in zip(weights, finite, strict=True)]
    for i, (before, after) in enumerate(zip(weights, found, strict=True)):
        if before.any() and not after.any():
            raise ValueError(f"{name} {i} is not finite in any pixel that counts: leave it and its camera out")
    if any(lost):
        _say(f"{sum(lost):,} pixels that are not finite have weight 0, in {_places(name, lost)}")
    return found


def _over(behind: Float[np.ndarray, "3"] | None, images: list[np.ndarray], name: str) -> list[np.ndarray]:
    """Three channels of each image: where it has an alpha, over what is behind."""
    counts, brighter = [0] * len(images), 0
    for i, image in enumerate(images):
        if image.shape[-1] == 3:
            continue
        alpha = image[..., 3]
        if not np.all((alpha >= 0) & (alpha <= 1.001)):
            raise ValueError(f"the alpha of {name} {i} goes from {alpha.min():g} to {alpha.max():g}: it must be from 0 to 1")
        if behind is None:
            raise ValueError(
                f"{name} {i} has an alpha, and what is behind it is to be found, or differs from pixel to pixel: a transparent picture "
                "says nothing about that, leave the background (and, where there is one, the exposure) out of the fit"
            )
        counts[i] = int(np.count_nonzero(alpha < 1))
        brighter += np.count_nonzero(np.max(image[..., :3], axis=-1) > 1.001 * alpha)
    if any(counts):
        assert behind is not None
        straight = f"; {brighter:,} are brighter than it: multiply colours that are straight by it" if brighter else ""
        _say(
            f"{sum(counts):,} pixels with an alpha below 1 are put over the background, {written(behind)}, in {_places(name, counts)}; "
            f"their colours are taken as multiplied by alpha already{straight}"
        )
    added = lambda image: (image[..., :3] + np.clip(1 - image[..., 3:], 0, 1) * behind).astype(image.dtype)
    return [image if image.shape[-1] == 3 else added(image) for image in images]


def _say_what_no_scene_gives(images: list[np.ndarray], name: str) -> None:
    """Names negative values, and codes that are no whole numbers."""
    negative = [np.count_nonzero(image < 0) for image in images]
    if any(negative):
        _say(f"{sum(negative):,} negative values, which no scene gives, in {_places(name, negative)}: is it a difference?")
    codes = [bool(image.size) and image.max() >= 16 and np.mean(image > 1) > 0.5 for image in images]
    if any(codes):
        brightest = max(image.max() for image, found in zip(images, codes, strict=True) if found)
        _say(f"{_places(name, codes)}: values go up to {brightest:g} and are mostly brighter than white, 1: are these codes?")


def _places(name: str, found: Sequence[Any]) -> str:
    """Which images something was found in."""
    indices = [i for i, one in enumerate(found) if one]
    shown = ", ".join(map(str, indices[:6])) + (f" and {len(indices) - 6} more" if len(indices) > 6 else "")
    return f"{name}{'s' if len(indices) > 1 else ''} {shown}"


def written(colour: Any) -> str:
    """A colour as one writes it."""
    return "(" + ", ".join(f"{float(c):.3g}" for c in colour) + ")"


def _say(text: str) -> None:
    # Of those who called `jvr.fit` or `jvr.residuals`.
    warnings.warn(text, stacklevel=5)
