"""Numbers and unknowns in the words of the page."""

import re
from collections.abc import Sequence

import numpy as np

from jvr.model.transfer import AbstractTable, AbstractTransfer, GaussianTransfer

# What fields of a transfer function and the columns of a colour are called.
TITLES = {
    "rgb": "colour",
    "sigma_t": "extinction",
    "emission": "emission",
    "height": "height",
    "center": "centre",
    "positions": "position",
}
COLOURS = ("red", "green", "blue")


def counted(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s"


def memory(count: int) -> str:
    for unit, each in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= each:
            return f"{count / each:.3g} {unit}"
    return f"{count} bytes" if count else "none"


def with_error(value: float, error: float) -> str:
    """A value and its standard error, the latter to two digits and the value to as many places: "0.4137 ± 0.0012"."""
    if not error > 0 or not np.isfinite(value):
        return f"{value:.5g} ± {error:.2g}"
    places = 1 - int(np.floor(np.log10(error)))
    if places > 8 or places < -3:
        return f"{value:.4g} ± {error:.2g}"
    places = max(places, 0)
    return f"{value:.{places}f} ± {error:.{places}f}"


def entries_in_words(indices: np.ndarray, transfer: AbstractTransfer) -> str:
    """Runs of entries: "entries 0 to 3, 7"."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    text = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
    noun = ("Gaussian", "Gaussians") if isinstance(transfer, GaussianTransfer) else ("entry", "entries")
    return f"{noun[len(indices) > 1]} {text}"


def least_determined_in_words(worst: Sequence[tuple[str, float]], transfer: AbstractTransfer) -> str:
    """The least-determined direction as a sentence: what one can raise and lower together without changing the pictures."""
    raised = _unknowns_in_words([name for name, coefficient in worst if coefficient > 0], transfer)
    lowered = _unknowns_in_words([name for name, coefficient in worst if coefficient < 0], transfer)
    if not lowered and not raised:
        return "No unknown changes the pictures."
    if not lowered or not raised:
        return f"Changing {_listed(raised or lowered)} together hardly changes the pictures."
    return f"Raising {_listed(raised)} while lowering {_listed(lowered)} hardly changes the pictures."


def _unknowns_in_words(names: Sequence[str], transfer: AbstractTransfer) -> list[str]:
    """`transfer.rgb[2, 1]` and `transfer.rgb[2, 0]` as "the red and green of entry 2 (at 0.133)"."""
    places = getattr(transfer, "positions", getattr(transfer, "center", None))
    noun = "entry" if isinstance(transfer, AbstractTable) else "Gaussian"
    channels: dict[tuple[str, str], list[int]] = {}
    for name in names:
        match = re.fullmatch(r"transfer\.(\w+)\[(\d+)(?:, (\d+))?\]", name)
        key = (match[1], match[2]) if match else (name.removesuffix("[]"), "")
        channels.setdefault(key, []).extend([int(match[3])] if match and match[3] else [])
    words = []
    for (field, entry), which in channels.items():
        coloured = _listed([COLOURS[c] for c in sorted(which)]) if which else ""
        what = TITLES.get(field, field)
        if field == "rgb":
            what = what if len(which) == 3 else coloured
        elif coloured:
            what = f"{what} in {coloured}"
        at = f" (at {float(places[int(entry)]):.4g})" if entry and places is not None else ""
        if field == "domain":
            words.append(f"the {('lower', 'upper')[int(entry)]} end of the domain")
        else:
            words.append(f"the {what} of {noun} {entry}{at}" if entry else field)
    return words


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
