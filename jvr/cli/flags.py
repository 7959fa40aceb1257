"""Numbers in flags."""

from typing import Any

from jvr.cli.inputs import BadInput


def given_of(shape: str | None, spacing: str | None, origin: str | None, direction: str | None, **others: Any) -> dict[str, Any]:
    """Keywords of a volume from its flags."""
    triples: dict[str, Any] = {"shape": triple(shape, "--shape", int), "spacing": triple(spacing, "--spacing", float)}
    triples |= {"origin": triple(origin, "--origin", float, positive=False), "direction": _matrix(direction)}
    if (missing := others.pop("missing")) is not None:
        triples["missing"] = False if missing.lower() == "none" else _number(missing, "--missing")
    return {name: value for name, value in (triples | others).items() if value is not None}


def _number(text: str, flag: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise BadInput(f"{flag} {text}: must be a number, or none") from None


def triple(text: str | None, flag: str, kind: type, *, positive: bool = True) -> list[Any] | None:
    """Three numbers along x, y, z."""
    if text is None:
        return None
    try:
        numbers = [kind(part) for part in text.replace("x", ",").split(",")]
        # One distance stands for all three.
        numbers = 3 * numbers if flag == "--spacing" and len(numbers) == 1 else numbers
    except ValueError:
        numbers = []
    if len(numbers) != 3 or (positive and min(numbers) <= 0):
        what = "whole numbers of voxels" if kind is int else "numbers of millimetres"
        example = "-120,-120,40.5" if not positive else "256,256,128" if kind is int else "0.5,0.5,2"
        raise BadInput(f"{flag} {text}: must be three {'positive ' if positive else ''}{what} along x, y, z, such as {example}")
    return numbers


def _matrix(text: str | None) -> list[list[float]] | None:
    """Nine numbers, axis by axis, as a matrix with the axes in its columns."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 9:
        raise BadInput(f"--direction {text}: must be nine numbers, the directions of x, y and z, such as 1,0,0,0,1,0,0,0,1")
    return [numbers[k::3] for k in range(3)]
