"""What a fit shows while it runs."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple


class Iteration(NamedTuple):
    """One line of a fit's history: `loss` is the objective, `psnr` in decibels relative to radiance 1 (of the rays in use),
    `seconds` since the start, `rays` the fraction of all rays in use."""

    step: int
    loss: float
    psnr: float
    seconds: float
    rays: float


@contextlib.contextmanager
def progress_bar(progress: Any, max_steps: int) -> Iterator[Callable[[Iteration], Any]]:
    """A function to call after each iteration."""
    if callable(progress):
        yield progress
    elif progress is False or (progress is None and not sys.stderr.isatty()):
        yield lambda _: None
    else:
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("fit", total=max_steps)
            yield lambda entry: bar.update(
                task, completed=entry.step, description=f"step {entry.step}  loss {entry.loss:.3e}  PSNR {entry.psnr:.1f} dB"
            )
