"""Damaged files: each is a whole one with a few changes, the same ones for the same seed; one of several may be lost or renamed."""

import re

import numpy as np

EXTREMES = [
    b"0",
    b"-1",
    b"1",
    b"4294967295",
    b"4294967296",
    b"9223372036854775807",
    b"99999999999999999999",
    b"5000",
    b"nan",
    b"inf",
]
EXTREMES += [
    b"1e308",
    b"-1e-308",
    b"0x10",
    b"1_0",
    b"",
    b"none",
    b"\xff\xfe",
    b"%d",
    b"../../../../etc/passwd",
    b"/dev/zero",
    b"(",
]
# What a name may be in place of its own, which takes the place of the word.
NAMES = ["{}~", ".{}", "{}.gz", "{}\n", "{}\udcff", " {}", "é{}", "-{}", "{}%d", "a" * 200 + "{}", "99999999999999999999{}"]
WHOLE = [0, 1, -1, 127, 128, 255, 32767, -32768, 65535, 2**31 - 1, -(2**31), 2**31, 2**32 - 1, 2**62, 5000, 70000]


def damaged(files: dict[str, bytes], rng: np.random.Generator) -> dict[str, bytes]:
    """Files by their paths, of which one is damaged, or, where there are several, lost or renamed; the first ones most often."""
    names = list(files)
    chosen = names[(int(rng.geometric(0.5)) - 1) % len(names)]
    what = rng.random() if len(files) > 1 else 1.0
    if what < 0.05:
        return {name: content for name, content in files.items() if name != chosen}
    if what < 0.15:
        return _renamed(files, chosen, rng)
    return files | {chosen: mutated(files[chosen], rng)}


def _renamed(files: dict[str, bytes], chosen: str, rng: np.random.Generator) -> dict[str, bytes]:
    """One file with another name, or that of another one, with which it changes places."""
    names = list(files)
    if rng.random() < 0.5:
        other = names[int(rng.integers(len(names)))]
        return files | {chosen: files[other], other: files[chosen]}
    folder, slash, last = chosen.rpartition("/")
    name = NAMES[int(rng.integers(len(NAMES)))].format(last) if rng.random() < 0.7 else re.sub(r"\d+", "7", last.swapcase())
    rest = {path: content for path, content in files.items() if path != chosen}
    return rest | {f"{folder}{slash}{name}": files[chosen]}


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes of a random kind."""
    for _ in range(int(rng.integers(1, 4))):
        content = KINDS[int(rng.integers(len(KINDS)))](content, rng)
    return content


def _place(content: bytes, rng: np.random.Generator) -> int:
    """A place in the file; half of them in the first 400 bytes, where headers are."""
    most = max(len(content), 1)
    return int(rng.integers(min(most, 400) if rng.random() < 0.5 else most))


def _flipped(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        if changed:
            changed[_place(content, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: _place(content, rng)]


def _spliced(content: bytes, rng: np.random.Generator) -> bytes:
    """A part of the file in another place of it, which is lost or moves on."""
    start, to, length = _place(content, rng), _place(content, rng), int(rng.integers(1, 200))
    kept = to + (length if rng.random() < 0.5 else 0)
    return content[:to] + content[start : start + length] + content[kept:]


def _noise(content: bytes, rng: np.random.Generator) -> bytes:
    to = _place(content, rng)
    noise = rng.integers(0, 256, int(rng.integers(1, 64)), dtype=np.uint8).tobytes()
    return content[:to] + noise + content[to + len(noise) :]


def _number(content: bytes, rng: np.random.Generator) -> bytes:
    """A number in text becomes an extreme one, or a word that is none."""
    numbers = list(re.finditer(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", content[:4096]))
    if not numbers:
        return _binary_number(content, rng)
    chosen = numbers[int(rng.integers(len(numbers)))]
    return content[: chosen.start()] + EXTREMES[int(rng.integers(len(EXTREMES)))] + content[chosen.end() :]


def _binary_number(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes of a number become those of an extreme one."""
    size, at = int(rng.choice([1, 2, 4, 8])), _place(content, rng)
    number = WHOLE[int(rng.integers(len(WHOLE)))] % 2 ** (8 * size)
    new = number.to_bytes(size, "little" if rng.random() < 0.5 else "big")
    return content[:at] + new + content[at + size :]


def _lines(content: bytes, rng: np.random.Generator) -> bytes:
    """A line is lost, comes many times, or changes its place with another."""
    lines = content.split(b"\n")
    a, b = (int(rng.integers(min(len(lines), 60))) for _ in range(2))
    match int(rng.integers(4)):
        case 0:
            del lines[a]
        case 1:
            lines[a:a] = [lines[a]] * int(rng.choice([1, 2, 100]))
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case 3:
            lines[a] = lines[a][: len(lines[a]) // 2] + lines[a] * int(rng.choice([2, 200]))
    return b"\n".join(lines)


def _swapped(content: bytes, rng: np.random.Generator) -> bytes:
    """The values of two lines of a header change places."""
    fields = list(re.finditer(rb"(?m)^[^\n:=]{1,60}[:=] ?([^\n]*)$", content[:4096]))
    if len(fields) < 2:
        return _spliced(content, rng)
    a, b = sorted(int(k) for k in rng.choice(len(fields), 2, replace=False))
    first, second = fields[a], fields[b]
    middle = content[first.end(1) : second.start(1)]
    return content[: first.start(1)] + second[1] + middle + first[1] + content[second.end(1) :]


KINDS = (_flipped, _cut, _spliced, _noise, _number, _number, _binary_number, _lines, _swapped)
