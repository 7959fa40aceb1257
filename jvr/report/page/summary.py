"""What a fit came to in a few numbers: how it ended, how near it came, and what the images tell least about."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from jvr.model.transfer import AbstractTransfer
from jvr.report.page.words import counted, duration, least_determined_in_words, memory
from jvr.report.plots.pictures import decibels
from jvr.types import Outcome

if TYPE_CHECKING:
    from jvr.fitting.result import FitResult, FitStats


def verdict(result: "FitResult", targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    """The fit in two sentences."""
    ended = {
        Outcome.CONVERGED: "The fit converged",
        Outcome.STEP_LIMIT: "The fit reached its limit of iterations before it converged",
        Outcome.STALLED: "The fit stalled before it converged: no step made the pictures any better",
        Outcome.NON_FINITE: "The fit met a value that is not finite and kept its last good state",
        Outcome.INTERRUPTED: "The fit was interrupted and kept its last good state",
    }[result.outcome]
    text = f"{ended}, after {counted(len(result.history), 'iteration')} and {duration(result.stats.seconds)}. "
    held_out = _held_out(result)
    if held_out is None:
        psnr = _all_decibels(targets, fitted)
        return f"{text}The images it was given come out with a PSNR of {psnr}; no other views were held out to check it."
    views, psnr, ssim = held_out
    come = "comes" if len(result.stats.held_out) == 1 else "come"
    return f"{text}{views} that took no part in it {come} out with a PSNR of {psnr} and an SSIM of {ssim}."


def _held_out(result: "FitResult") -> tuple[str, str, str] | None:
    """Number, mean PSNR and mean SSIM of the held-out views, in words."""
    scores = result.stats.held_out
    if not scores:
        return None
    psnr, ssim = np.mean(scores, axis=0)
    return counted(len(scores), "view"), "identical" if psnr == np.inf else f"{psnr:.1f} dB", f"{ssim:.4f}"


def summary(result: "FitResult", targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    stats, count = result.stats, _unknown_count(result)
    tiles = [
        ("outcome", result.outcome.value.partition(";")[0], ""),
        ("iterations", f"{len(result.history)}", ""),
        ("time", duration(stats.seconds), "compiling included"),
        ("PSNR, fitted views", _all_decibels(targets, fitted), f"{counted(len(targets), 'image')}, radiance 1 is the peak"),
    ]
    if held_out := _held_out(result):
        views, psnr, ssim = held_out
        tiles += [("PSNR, held-out views", psnr, f"mean of {views}"), ("SSIM, held-out views", ssim, f"mean of {views}")]
    tiles += []
    if not np.isnan(stats.condition):
        tiles += [
            ("residual", f"{np.sqrt(stats.residual_variance):.2g}", "radiance, root mean square of a channel"),
            ("rank", f"{stats.rank} of {count}", "combinations of unknowns that the images determine"),
        ]
    kept = "volume values along the rays" if stats.kept_bytes else "resampled in every step"
    tiles.append(("kept samples", memory(stats.kept_bytes), kept))
    if result.exposure != 1.0:
        tiles.append(("exposure", f"{result.exposure:.4g}", "fitted factor from rendered to target radiance"))
    cell = lambda name, value, note: (
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}{f'<small>{escape(note)}</small>' if note else ''}</dd></div>"
    )
    return "<dl>" + "".join(cell(*tile) for tile in tiles) + "</dl>"


def _unknown_count(result: "FitResult") -> int:
    """Exposure is an unknown too where it was fitted, but has no entry among the standard errors."""
    return sum(errors.size for errors in result.errors_by_name.values()) + (result.exposure != 1.0)


def _all_decibels(targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    flat = lambda images: np.concatenate([np.ravel(np.asarray(image)) for image in images])
    return decibels(flat(targets), flat(fitted))


def identifiability(result: "FitResult", transfer: AbstractTransfer) -> str:
    stats, count = result.stats, _unknown_count(result)
    if np.isnan(stats.condition):
        text = f"{count:,} unknowns are too many for a Gauss-Newton matrix: jvr.voxel_errors estimates errors of voxels."
        return f"<h2>What the images tell least about</h2><p>{text}</p>"
    missing = count - stats.rank
    if missing > 0:
        are = "are" if missing > 1 else "is"
        rank = f"{counted(missing, 'combination')} of the {count} unknowns {are} not determined by the images at all."
    else:
        ratio = f"{np.sqrt(stats.condition):.2g}"
        rank = f"The images determine all {count} unknowns, the best combination {ratio} times as sharply as the worst."
    parts = [f"<h2>What the images tell least about</h2><p>{rank}</p>"]
    if stats.worst:
        parts.append(f"<p>{escape(least_determined_in_words(stats.worst, transfer))}</p>")
        share = "; ".join(f"{name} {coefficient:+.2f}" for name, coefficient in stats.worst)
        parts.append(f'<p class="soft">Largest coefficients, each unknown in units of its own sensitivity: {escape(share)}.</p>')
    return "".join((*parts, _smoothed(stats), _misfit(stats)))


def _smoothed(stats: "FitStats") -> str:
    if not stats.smoothed:
        return ""
    listed = " and ".join(f"{count} of {escape(name)}" for name, count in stats.smoothed)
    return (
        f"<p>What the images (nearly) leave open was continued smoothly from the neighbouring entries, {listed}: that adds at most 0.01 dB "
        "of error, and these values mean no more than their standard errors say.</p>"
    )


def _misfit(stats: "FitStats") -> str:
    if not stats.is_misfit:
        return ""
    return (
        "<p>Neighbouring pixels are wrong in the same way: sums of residuals over squares of pixels vary "
        f"{stats.design_effect:.3g} times as much as those of noise would. This model does not explain the images, whatever its unknowns "
        "(another renderer's sampling, a camera's blur, light or shading that it lacks, too few entries); standard errors allow for "
        "that, and suppose that unknowns have absorbed an error of brightness and of contrast as large as the residuals.</p>"
    )
