"""Legacy VTK files of structured points (.vtk), text or big-endian bytes, after VTK's "File Formats"."""

import functools
import mmap
import re
import urllib.parse
from pathlib import Path

import numpy as np

from jvr.io.volumes import payload
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, grid_shape, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored
from jvr.io.volumes.vtk_arrays import Array, Grid, volume_of

TYPES = {"char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4"}
TYPES |= {"unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtktypeuint64": "u8"}
TYPES |= {"float": "f4", "double": "f8", "vtkidtype": "i4", "bit": "u1"}
COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}
LONGEST_LINE, MOST_ARRAYS = 4096, 10_000


class _Cut(Exception):
    """The file ends, or says nothing that a VTK file could, at this place."""


def read_legacy_vtk(path: Path, given: Given) -> Stored:
    """Structured points; `array` names one of several arrays, `channel` one component of it."""
    start = first_bytes(path)
    if not start.startswith(b"# vtk DataFile"):
        raise mislabelled(path, start, "a legacy VTK file (its first line begins with '# vtk DataFile')")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        walk = _Walk(path, content)
        try:
            walk.through()
        except _Cut as cut:
            walk.problem = str(cut)
        grid = walk.grid(given)
        # Of what is missing nobody knows the names: only an array that is asked for, or the active scalars, are read all the same.
        if walk.problem and not [
            array for array in walk.arrays if array.name == given.array or (given.array is None and array.active)
        ]:
            raise VolumeError(path, f"{walk.problem}: the file is cut short or damaged; copy or export it again")
        stored = volume_of(path, grid, walk.arrays, given)
    if walk.problem:
        payload.said(path, f"what follows array '{walk.arrays[-1].name[:80]}' is damaged and left out ({walk.problem})")
    return stored


class _Walk:
    """One way through a file, which notes the arrays without reading them."""

    def __init__(self, path: Path, content: mmap.mmap):
        self.path, self.content, self.position = path, content, 0
        self.text, self.problem = False, ""
        self.fields: dict[str, list[str]] = {}
        self.arrays: list[Array] = []
        self.cells: bool | None = None
        self.tuples = 0

    def through(self) -> None:
        # Line 2 is a title, which may be blank.
        self._line()
        self._line()
        encoding = " ".join(self._words()).upper()
        if encoding not in ("ASCII", "BINARY"):
            raise VolumeError(self.path, f"line 3 is '{encoding[:40]}'; it must be ASCII or BINARY")
        self.text = encoding == "ASCII"
        while words := self._words():
            self._section(words[0].upper(), words)
            if len(self.arrays) > MOST_ARRAYS:
                raise _Cut(f"more than {MOST_ARRAYS:,} arrays")

    def grid(self, given: Given) -> Grid:
        kind = " ".join(self.fields.get("DATASET", ["missing"])).upper()
        if kind != "STRUCTURED_POINTS":
            raise VolumeError(self.path, f"DATASET is {kind[:40]}; only STRUCTURED_POINTS is a volume: resample it to image data")
        if "DIMENSIONS" not in self.fields or (self.cells is None and not self.arrays):
            wanted = "DIMENSIONS" if "DIMENSIONS" not in self.fields else "POINT_DATA with an array such as SCALARS"
            raise VolumeError(self.path, f"the header lacks {wanted}: the file is cut short or holds no volume")
        points = grid_shape(self.path, "DIMENSIONS", self.fields["DIMENSIONS"][:40])
        key = next((key for key in ("SPACING", "ASPECT_RATIO") if key in self.fields), None)
        spacing, origin = [1.0] * 3, [0.0] * 3
        if given.spacing is None and key is not None:
            spacing = grid_numbers(self.path, key, self.fields[key][:40], positive=True)
        elif given.spacing is None:
            payload.said(self.path, "the header lacks SPACING: voxels are taken as 1 long in x, y, z; else give spacing=")
        if given.origin is None and "ORIGIN" in self.fields:
            origin = grid_numbers(self.path, "ORIGIN", self.fields["ORIGIN"][:40], positive=False)
        if not len(points) == len(spacing) == len(origin) == 3:
            raise VolumeError(self.path, "DIMENSIONS, SPACING and ORIGIN must be three numbers each: correct them")
        return Grid(points, spacing, origin)

    # --- Lines and sections ------------------------------------------------------------------------------------------

    def _line(self) -> str:
        end = self.content.find(b"\n", self.position, self.position + LONGEST_LINE)
        if end < 0:
            end = min(self.position + LONGEST_LINE, len(self.content))
            if end - self.position == LONGEST_LINE:
                raise _Cut(f"a line of more than {LONGEST_LINE:,} bytes where a keyword should be")
        line = self.content[self.position : end]
        self.position = min(end + 1, len(self.content))
        return line.decode("latin-1")

    def _words(self) -> list[str]:
        """The words of the next line that is not blank; none at the end of the file."""
        while self.position < len(self.content):
            if words := self._line().split():
                return words
        return []

    def _section(self, keyword: str, words: list[str]) -> None:
        name, rest = (words[1] if len(words) > 1 else ""), words[2:]
        if keyword in ("POINT_DATA", "CELL_DATA"):
            self.cells, self.tuples = keyword == "CELL_DATA", self._whole(name)
        elif keyword == "METADATA":
            # Names and facts about arrays, up to a blank line.
            while self.position < len(self.content) and self._line().strip():
                pass
        elif keyword == "FIELD":
            self._field(self._whole(rest[0] if rest else ""))
        elif self.cells is None:
            self.fields[keyword] = words[1:]
        elif keyword == "SCALARS":
            self._scalars(name, rest)
        elif keyword == "COLOR_SCALARS":
            self._note(name, self._whole(rest[0] if rest else ""), self.tuples, "float" if self.text else "unsigned_char")
        elif keyword == "LOOKUP_TABLE":
            self._skip(4 * self._whole(rest[0] if rest else ""), np.dtype("u1"))
        elif keyword == "TEXTURE_COORDINATES":
            self._note(name, self._whole(rest[0] if rest else ""), self.tuples, rest[1] if len(rest) > 1 else "")
        elif keyword in COMPONENTS:
            self._note(name, COMPONENTS[keyword], self.tuples, rest[0] if rest else "")
        else:
            raise _Cut(f"'{words[0][:40]}' is no keyword")

    def _scalars(self, name: str, rest: list[str]) -> None:
        components = self._whole(rest[1]) if len(rest) > 1 else 1
        table = self.position
        if self._words()[:1] != ["LOOKUP_TABLE"]:
            self.position = table
        active = not any(array.active and array.cells == self.cells for array in self.arrays)
        self._note(name, components, self.tuples, rest[0] if rest else "", active=active)

    def _field(self, count: int) -> None:
        for _ in range(min(count, MOST_ARRAYS)):
            words = self._words()
            if words and words[0].upper() == "METADATA":
                self._section("METADATA", words)
                words = self._words()
            if len(words) < 4:
                raise _Cut(f"'{' '.join(words)[:40]}' is no array of a FIELD")
            self._note(words[0], self._whole(words[1]), self._whole(words[2]), words[3])

    def _whole(self, word: str) -> int:
        if not re.fullmatch(r"\d{1,12}", word, re.ASCII):
            raise _Cut(f"'{word[:40]}' stands where a whole number should")
        return int(word)

    def _note(self, name: str, components: int, tuples: int, kind: str, *, active: bool = False) -> None:
        code = TYPES.get(kind.lower())
        if code is None:
            raise _Cut(f"an array of type '{kind[:40]}', which is no number")
        dtype, start = np.dtype(code).newbyteorder(">"), self.position
        packed = kind.lower() == "bit" and not self.text
        count = components * tuples
        size = (count + 7) // 8 if packed else count * dtype.itemsize
        remaining = len(self.content) - start
        read = functools.partial(self._numbers, start, count, dtype, packed=packed)
        stored = remaining * dtype.itemsize if self.text else remaining * 8 if packed else remaining
        if self.cells is not None and components > 0:
            shown = urllib.parse.unquote(name)
            self.arrays.append(Array(shown, components, tuples, dtype, self.cells, active, stored, read))
        self._skip(count, dtype) if self.text else self._skip_bytes(size)

    def _skip(self, count: int, dtype: np.dtype) -> None:
        if not self.text:
            self._skip_bytes(count * dtype.itemsize)
            return
        end = _behind_words(self.content, self.position, count)
        if end is None:
            raise _Cut("its numbers end early")
        self.position = end

    def _skip_bytes(self, size: int) -> None:
        if size > len(self.content) - self.position:
            raise _Cut("its bytes end early")
        self.position += size

    def _numbers(self, start: int, count: int, dtype: np.dtype, *, packed: bool) -> np.ndarray:
        if self.text:
            return payload.numbers_of(self.path, payload.parts_of(self.content, start, len(self.content)), count, dtype)
        size = (count + 7) // 8 if packed else count * dtype.itemsize
        if size > len(self.content) - start:
            check_size(self.path, [count], dtype.itemsize, len(self.content) - start)
        found = np.frombuffer(self.content[start : start + size], np.uint8)
        return np.unpackbits(found, count=count) if packed else found.view(dtype)


def _behind_words(content: mmap.mmap, position: int, count: int) -> int | None:
    """The place behind so many words, `None` where there are fewer."""
    inside = False
    while count > 0 and position < len(content):
        part = np.frombuffer(content[position : position + payload.PIECE], np.uint8) > 32
        # A word ends where something is followed by white space.
        ends = np.flatnonzero(~part & np.concatenate([[inside], part[:-1]]))
        if len(ends) >= count:
            return position + int(ends[count - 1])
        count, inside, position = count - len(ends), bool(part[-1]), position + len(part)
    return position if count == 0 or (count == 1 and inside) else None
