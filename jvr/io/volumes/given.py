"""What the caller of `read_volume` says about a file, beside its name: it wins over what the file says."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Given:
    """The keywords of `read_volume`; `None` where the file decides. A header that contradicts them, or that would be refused for what they
    replace, is not asked.

    `spacing`, `origin`: three numbers in mm; `direction`: 3x3, unit vectors of the grid's axes in its columns.
    """

    shape: Sequence[int] | None = None
    dtype: Any = None
    spacing: np.ndarray | None = None
    origin: np.ndarray | None = None
    direction: np.ndarray | None = None
    slope: float | int | None = None
    intercept: float | int | None = None
    array: str | None = None
    series: str | None = None
    axes: str | None = None
    channel: int | np.integer | str | None = None
    time: int | np.integer | None = None
    missing: float | int | bool | None = None
    nan_value: float | int | None = None
