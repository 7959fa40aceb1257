"""Units of length, as files write them: symbols, words and plurals, in the spelling of SI, OME, UDUNITS, ImageJ, NRRD and DICOM."""

import html
import os
import re
import unicodedata
import warnings

# Powers of ten of SI's prefixes: symbol and word. Greek mu (U+03BC) stands for the micro sign, too.
PREFIXES = {
    "Q": (30, "quetta"), "R": (27, "ronna"), "Y": (24, "yotta"), "Z": (21, "zetta"), "E": (18, "exa"), "P": (15, "peta"),
    "T": (12, "tera"), "G": (9, "giga"), "M": (6, "mega"), "k": (3, "kilo"), "h": (2, "hecto"), "da": (1, "deca"), "": (0, ""),
    "d": (-1, "deci"), "c": (-2, "centi"), "m": (-3, "milli"), "\u03bc": (-6, "micro"), "u": (-6, "micro"), "mc": (-6, "micro"),
    "n": (-9, "nano"), "p": (-12, "pico"), "f": (-15, "femto"), "a": (-18, "atto"), "z": (-21, "zepto"), "y": (-24, "yocto"),
    "r": (-27, "ronto"), "q": (-30, "quecto"),
}  # fmt: skip
INCH = 25.4
# What is no multiple of a metre by a power of ten, in mm. Symbols, whose case counts:
SYMBOLS = {
    "\u00c5": 1e-7,
    "in": INCH,
    '"': INCH,
    "\u2033": INCH,
    "ft": 12 * INCH,
    "yd": 36 * INCH,
    "mi": 63360 * INCH,
    "pt": INCH / 72,
}
SYMBOLS |= {"thou": INCH / 1000, "mil": INCH / 1000, "li": INCH / 12, "\u03bc": 1e-3, "ly": 9460730472580800e3}
SYMBOLS |= {"ua": 149597870700e3, "au": 149597870700e3, "AU": 149597870700e3, "pc": 149597870700e3 * 648000 / 3.141592653589793}
# Words, in any case:
WORDS = {"angstrom": 1e-7, "\u00e5ngstr\u00f6m": 1e-7, "\u00e5ngstrom": 1e-7, "micron": 1e-3, "fermi": 1e-12, "inch": INCH}
WORDS |= {"inche": INCH, "foot": 12 * INCH, "feet": 12 * INCH, "yard": 36 * INCH, "mile": 63360 * INCH, "point": INCH / 72}
WORDS |= {"pica": INCH / 6, "line": INCH / 12, "thou": INCH / 1000, "thousandth": INCH / 1000, "mil": INCH / 1000}
WORDS |= {"parsec": SYMBOLS["pc"], "lightyear": SYMBOLS["ly"], "astronomicalunit": SYMBOLS["ua"], "international inch": INCH}
WORDS |= {
    "internationalinch": INCH,
    "internationalfoot": 12 * INCH,
    "internationalyard": 36 * INCH,
    "internationalmile": 63360 * INCH,
}
WORDS |= {"internationalfeet": 12 * INCH, "dekametre": 1e4, "dekameter": 1e4}
for _symbol, (_power, _word) in PREFIXES.items():
    # As text, so that each is the nearest float64: 10.0 ** -3 * 1000 need not be.
    SYMBOLS[f"{_symbol}m"] = float(f"1e{_power + 3}")
    WORDS |= dict.fromkeys((f"{_word}metre", f"{_word}meter"), float(f"1e{_power + 3}"))
# Capitals by habit, which stand for no other unit.
SYMBOLS |= {"MM": 1.0, "CM": 10.0, "UM": 1e-3, "NM": 1e-6, "KM": 1e6, "IN": INCH, "FT": 12 * INCH}
NO_LENGTH = (
    "pixel",
    "voxel",
    "px",
    "referenceframe",
    "arbitraryunit",
    "a.u.",
    "arb",
    "none",
    "null",
    "unknown",
    "index",
    "grayvalue",
)


def length_of(unit: str | None) -> float | None:
    """How many millimetres one `unit` is; `None` where it is no length that is known."""
    text = _plain(unit)
    if text in SYMBOLS:
        return SYMBOLS[text]
    word = re.sub(r"[\s_-]", "", text).casefold()
    return WORDS.get(word, WORDS.get(word.removesuffix("s")))


def millimetres(path: str | os.PathLike, field: str, unit: str | None) -> float:
    """How many millimetres one `unit` is. One that is unknown, or missing, counts as a millimetre, with a warning that names `field`."""
    found = length_of(unit)
    if found is not None:
        return found
    text = _plain(unit)
    word = re.sub(r"[\s_-]", "", text).casefold()
    problem = f"the unit '{text}' is unknown" if text else "no unit of length is given"
    if word.removesuffix("s") in NO_LENGTH or word in NO_LENGTH:
        problem = f"the unit '{text}' is no length"
    warnings.warn(f"{path}: {field}: {problem}; its numbers are taken for millimetres: give spacing= in mm", stacklevel=2)
    return 1.0


def _plain(unit: str | None) -> str:
    """A unit without entities (&#181;), escapes (backslash u00B5), the two signs for micro and angstrom, and "per pixel"."""
    text = html.unescape(str(unit or "").replace("\x00", ""))
    text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda found: chr(int(found[1], 16)), text)
    text = re.sub(r"\\x?([bB]5)|\u00c2(?=\u00b5)", lambda found: "\u00b5" if found[1] else "", text)
    text = " ".join(unicodedata.normalize("NFKC", text).split()).strip("[]() '")
    return re.sub(r"\s*(/|\bper\b)\s*(pixel|px|voxel|slice|sample)s?$", "", text, flags=re.IGNORECASE)
