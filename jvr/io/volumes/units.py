"""Units of length, as files write them."""

import os
import warnings

MILLIMETRES = {"nanometer": 1e-6, "nm": 1e-6, "micrometer": 1e-3, "micron": 1e-3, "um": 1e-3, "µm": 1e-3, "\\u00b5m": 1e-3}
MILLIMETRES |= {"millimeter": 1.0, "mm": 1.0, "centimeter": 10.0, "cm": 10.0, "inch": 25.4, "meter": 1000.0, "m": 1000.0}


def millimetres(path: str | os.PathLike, field: str, unit: str | None) -> float:
    """How many millimetres one `unit` is. One that is unknown, or missing, counts as a millimetre, with a warning that names `field`."""
    found = MILLIMETRES.get((unit or "").strip().lower())
    if found is not None:
        return found
    problem = f"the unit '{unit}' is unknown" if unit else "no unit of length is given"
    warnings.warn(f"{path}: {field}: {problem}; its numbers are taken for millimetres: give spacing= in mm", stacklevel=2)
    return 1.0
