"""NRRD (.nrrd, .nhdr), after the definition of its format by Teem: https://teem.sourceforge.net/nrrd/format.html."""

import math
import re
from pathlib import Path

import numpy as np

from jvr.io.volumes import payload
from jvr.io.volumes.axes import chosen
from jvr.io.volumes.directions import check_volume, completed
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, grid_shape, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.units import millimetres

ENCODINGS = {"raw": "raw", "txt": "text", "text": "text", "ascii": "text", "hex": "hex"}
ENCODINGS |= {"gz": "gzip", "gzip": "gzip", "bz2": "bz2", "bzip2": "bz2"}
# What turns the file's world into left, posterior, superior.
SPACES = {"right-anterior-superior": (-1, -1, 1), "left-anterior-superior": (1, -1, 1), "left-posterior-superior": (1, 1, 1)}
SPACES |= {"ras": (-1, -1, 1), "las": (1, -1, 1), "lps": (1, 1, 1)}
SPATIAL = ("domain", "space", "none", "???", "point", "stub", "scalar")

Fields = dict[str, str]


def read_nrrd(path: Path, given: Given) -> Stored:
    """A NRRD, its voxels attached (.nrrd) or in other files (.nhdr); `channel` and `time` choose along axes that are not space."""
    start = first_bytes(path)
    if not re.match(rb"NRRD\d{4}\s*\n", start):
        raise mislabelled(path, start, "a NRRD file (its content begins with 'NRRD000' and a digit)")
    blank = re.search(rb"\r?\n\r?\n", start)
    header = start[: blank.start() if blank else len(start)].decode("latin-1")
    pairs = re.findall(r"^([A-Za-z][A-Za-z ]{0,40}): (.*)$", header, re.MULTILINE)
    fields = {key.lower().replace(" ", ""): value.strip() for key, value in pairs}
    if missing := [key for key in ("sizes", "type", "encoding") if key not in fields]:
        raise VolumeError(path, f"the header lacks the line '{missing[0]}: ...'")
    shape = grid_shape(path, "sizes", fields["sizes"].split())
    if _whole(path, fields, "dimension", str(len(shape))) != len(shape) or len(shape) > 5:
        raise VolumeError(
            path, f"dimension is '{fields.get('dimension', '')[:40]}', sizes are {len(shape)} numbers: correct them"
        )
    letters = _letters(path, fields, shape)
    of_all = chosen(path, shape, letters, given)
    values = _values(path, fields, shape, header, blank.end() if blank else len(start))
    if "oldmin" in fields and "oldmax" in fields and given.slope is None:
        low, high = fields["oldmin"][:40], fields["oldmax"][:40]
        payload.said(
            path, f"its values were rounded from numbers between {low} and {high}, which slope= and intercept= can restore"
        )
    return Stored(
        of_all.of(values.reshape(shape, order="F")),
        _affine(path, fields, letters, shape, given),
        unit=fields.get("sampleunits", "").strip('"').strip(),
    )


def _whole(path: Path, fields: Fields, name: str, default: str = "0") -> int:
    text = fields.get(name, default)
    if not re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
        raise VolumeError(path, f"{name} is '{text[:40]}'; it must be a whole number")
    return int(text)


def _dtype(path: Path, name: str) -> np.dtype:
    """NRRD spells a type in up to six ways ("unsigned short int", "ushort", "uint16_t", ...)."""
    text = re.sub(r"\s+", " ", name.lower()).strip()
    if text in ("float", "double"):
        return np.dtype({"float": "f4", "double": "f8"}[text])
    match = re.fullmatch(r"(unsigned ?|signed ?|u)?(char|short(?: int)?|long ?long(?: int)?|int(?:(8|16|32|64)(?:_t)?)?)", text)
    if match is None:
        problem = "holds blocks of bytes" if text == "block" else "is no number type"
        raise VolumeError(path, f"type '{name[:40]}' {problem}; short or float would be a number")
    sign, word, bits = match.groups()
    size = int(bits) // 8 if bits else {"char": 1, "shor": 2, "long": 8, "int": 4}[word[:4]]
    return np.dtype(f"{'u' if sign and sign[0] == 'u' else 'i'}{size}")


# --- Voxels ----------------------------------------------------------------------------------------------------------


def _values(path: Path, fields: Fields, shape: tuple[int, ...], header: str, header_bytes: int) -> np.ndarray:
    encoding = ENCODINGS.get(fields["encoding"].lower())
    if encoding is None:
        raise VolumeError(path, f"encoding '{fields['encoding'][:40]}' is not read; save it as raw, gzip, bzip2, ascii or hex")
    dtype = _dtype(path, fields["type"])
    if dtype.itemsize > 1 and encoding != "text":
        order = fields.get("endian", "").lower()
        if order not in ("little", "big"):
            if order:
                raise VolumeError(path, f"endian is '{order[:40]}'; it must be little or big")
            payload.said(path, "the header lacks 'endian: ...'; its bytes are taken for little-endian")
        dtype = dtype.newbyteorder(">" if order == "big" else "<")
    count = math.prod(shape) * dtype.itemsize
    files = _files(path, fields, shape, header)
    skip, lines = _whole(path, fields, "byteskip"), max(_whole(path, fields, "lineskip"), 0)
    begin = header_bytes if files == [path] else 0
    offsets = [_behind_lines(path, file, begin, lines) for file in files]
    stored = payload.room(path, files, offsets)
    packed = encoding in ("gzip", "bz2")
    itemsize = 1 if encoding == "text" else dtype.itemsize
    check_size(path, shape, itemsize, stored * payload.TIGHTER.get(encoding, 1), compressed=packed)
    check_size(path, shape, dtype.itemsize, None)
    if encoding == "raw":
        shifted = None if skip < 0 else [offset + skip for offset in offsets]
        return payload.slabs(path, files, shifted, count).view(dtype)
    if skip < 0:
        raise VolumeError(path, f"byte skip {skip} is for raw voxels, these are encoded as {encoding}: correct it")
    if packed:
        each, rest = divmod(count, len(files))
        if rest or skip > payload.MOST_SKIPPED:
            raise VolumeError(
                path, f"its {len(files):,} files, or a byte skip of {skip:,}, do not fit the voxels: correct the header"
            )
        streams = (payload.pieces_of(file, offset) for file, offset in zip(files, offsets, strict=True))
        return np.concatenate([payload.unpacked(path, stream, encoding, each, skip) for stream in streams]).view(dtype)
    text = payload.text_of(files, [offset + skip for offset in offsets])
    if encoding == "hex":
        return payload.bytes_of_hex(path, text, count).view(dtype)
    return payload.numbers_of(path, text, math.prod(shape), dtype)


def _files(path: Path, fields: Fields, shape: tuple[int, ...], header: str) -> list[Path]:
    name = fields.get("datafile")
    if name is None:
        return [path]
    words = name.split()
    if words[:1] == ["LIST"]:
        lines = header.splitlines()
        at = next(k for k, line in enumerate(lines) if re.match(r"data ?file:", line, re.IGNORECASE))
        names = [line.strip() for line in lines[at + 1 :] if line.strip()][: payload.MOST_FILES]
        if not names:
            raise VolumeError(path, "its LIST of data files is empty: it is cut short")
    else:
        names = payload.numbered(path, words, shape[-1]) if "%" in name else [name]
    return [payload.data_file(path, name) for name in names]


def _behind_lines(path: Path, file: Path, offset: int, lines: int) -> int:
    """The place behind so many lines."""
    if lines == 0:
        return offset
    with file.open("rb") as source:
        source.seek(offset)
        for _ in range(lines):
            if not source.readline(payload.PIECE).endswith(b"\n"):
                raise VolumeError(path, f"line skip {lines:,} leads behind the end of {file.name}: correct it")
        return source.tell()


# --- Axes and where they lie -----------------------------------------------------------------------------------------


def _listed(fields: Fields, name: str, count: int) -> list[str]:
    """One word for each axis, quoted ones without their quotes; empty where there is none."""
    words = [quoted if mark else word for word, mark, quoted in re.findall(r'((")([^"]*)"|[^\s"]+)', fields.get(name, ""))]
    return (words + [""] * count)[:count]


def _vectors(path: Path, fields: Fields, count: int) -> list[list[float] | None]:
    """The direction of each axis, in the file's world, `None` where it is "none"."""
    found = re.findall(r"none|\([^()]*\)", fields.get("spacedirections", ""), re.IGNORECASE)
    if found and len(found) != count:
        raise VolumeError(path, f"space directions are {len(found)} for {count} axes: correct them")
    numbers = lambda text: grid_numbers(path, "space directions", text[1:-1].split(","), positive=False)
    # Axes without a direction may also be written as vectors of "nan".
    vectors = [None if "n" in text.lower() else numbers(text) for text in found] or [None] * count
    if len({len(vector) for vector in vectors if vector is not None}) > 1:
        raise VolumeError(path, "space directions are vectors of different lengths: correct them")
    return vectors


def _letters(path: Path, fields: Fields, shape: tuple[int, ...]) -> str:
    """What each axis is: x, y, z in the order of the file, c for lists and vectors, t for time."""
    kinds, labels = _listed(fields, "kinds", len(shape)), _listed(fields, "labels", len(shape))
    placed = "spacedirections" in fields
    letters, spatial = "", iter("xyz")
    vectors = _vectors(path, fields, len(shape))
    for kind, label, vector in zip((k.lower() for k in kinds), labels, vectors, strict=True):
        in_time = vector is not None and len(vector) > 3 and not any(vector[:3])
        if kind == "time" or in_time or label.lower() in ("t", "time"):
            letter = "t"
        elif (placed and vector is None) or (kind and kind not in SPATIAL):
            letter = "c"
        else:
            letter = next(spatial, "t")
        if letter in letters:
            raise VolumeError(path, f"its axes ({' '.join(kinds)}) are more than space, one time and one list: save a part of it")
        letters += letter
    return letters


def _affine(path: Path, fields: Fields, letters: str, shape: tuple[int, ...], given: Given) -> np.ndarray:
    spatial = [k for k, letter in enumerate(letters) if letter in "xyz"]
    if "spacedirections" in fields and not (given.spacing is not None and given.direction is not None):
        return _in_space(path, fields, spatial, len(shape), given)
    return _on_axes(path, fields, spatial, shape, given)


def _in_space(path: Path, fields: Fields, spatial: list[int], count: int, given: Given) -> np.ndarray:
    space = re.sub("-time$", "", fields.get("space", "").lower())
    flip = SPACES.get(space.removesuffix("t"), SPACES.get(space))
    if flip is None and given.direction is None:
        shown = f"space '{space[:40]}'" if space else "a world without 'space: ...'"
        payload.said(path, f"{shown} does not say where left is: its axes are taken for LPS; else give direction=")
    units = [1.0] * 3
    # In the worlds of a body, millimetres are the custom.
    if "spaceunits" in fields or flip is None:
        units = _scales(path, "space units", _listed(fields, "spaceunits", 3)) if given.spacing is None else units
    columns, scale = np.zeros((3, 3)), np.array(flip or (1, 1, 1)) * units
    vectors = _vectors(path, fields, count)
    for column, k in enumerate(spatial):
        vector = (vectors[k] or [])[:3]
        columns[: len(vector), column] = vector
        if not any(vector):
            shown = ",".join(f"{x:g}" for x in vector)
            raise VolumeError(
                path, f"space directions hold ({shown}), a spacing of zero: correct it, or give spacing= and direction="
            )
    columns = completed(scale[:, None] * columns)
    check_volume(path, "space directions", columns)
    origin = fields.get("spaceorigin", "")
    numbers = (
        []
        if given.origin is not None
        else grid_numbers(path, "space origin", origin.strip("() ").replace(",", " "), positive=False)
    )
    return affine_of([1, 1, 1], scale * (numbers + [0.0] * 3)[:3], columns)


def _scales(path: Path, field: str, units: list[str]) -> list[float]:
    """Millimetres of each unit; what is odd about one is said once."""
    known = {unit: millimetres(path, field, unit) for unit in dict.fromkeys(units)}
    return [known[unit] for unit in units]


def _on_axes(path: Path, fields: Fields, spatial: list[int], shape: tuple[int, ...], given: Given) -> np.ndarray:
    """A grid along the axes of the world: `spacings`, or else `axis mins` and `axis maxs`, which are ends of cells or of nodes."""
    of_space = lambda name: [_listed(fields, name, len(shape))[k] for k in spatial]
    centres = [a or b for a, b in zip(of_space("centers"), of_space("centerings"), strict=True)]
    nodes = [centre.lower() == "node" for centre in centres]
    low = [_number(path, "axis mins", word) for word in of_space("axismins")]
    spacing, origin = np.ones(3), np.zeros(3)
    units = [1.0] * len(spatial)
    if given.spacing is None:
        lengths = [_number(path, "spacings", word, positive=True) for word in of_space("spacings")]
        high = [_number(path, "axis maxs", word) for word in of_space("axismaxs")]
        for i, (k, start, end) in enumerate(zip(spatial, low, high, strict=True)):
            if lengths[i] is None and start is not None and end is not None:
                extent = grid_numbers(path, "axis maxs - axis mins", [f"{end - start:.17g}"], positive=True)[0]
                lengths[i] = extent / max(shape[k] - nodes[i], 1)
        known = [length for length in lengths if length is not None]
        if len(known) < len(lengths):
            payload.said(path, "the header states no voxel size: voxels are taken as 1 mm; else give spacing=")
        else:
            units = _scales(path, "units", of_space("units"))
            spacing[: len(spatial)] = np.array(known) * units
    for i, start in enumerate(low):
        if given.origin is None and start is not None:
            origin[i] = start * units[i] + (0 if nodes[i] else spacing[i] / 2)
    return affine_of(spacing, origin)


def _number(path: Path, name: str, word: str, *, positive: bool = False) -> float | None:
    """A number of one axis; "nan" stands where there is none."""
    return None if word.lower() in ("", "nan") else grid_numbers(path, name, [word], positive=positive)[0]
