"""Which standard error belongs to which field of a transfer function."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jvr.model.parameters import range_at
from jvr.model.ranges import Interval
from jvr.model.transfer import AbstractTransfer


def field_errors(
    transfer: AbstractTransfer, standard_errors: Mapping[str, Any] | AbstractTransfer | None
) -> dict[str, np.ndarray]:
    """Standard errors by the name of the transfer function's field: `rgb`, `sigma_t`, `positions`, `height`, ...

    **Arguments:** `standard_errors`: a mapping from fields, called `"rgb"` or, as `FitResult.errors_by_name` does,
    `"transfer.rgb"`; or a transfer function that holds errors in place of values. What is not a field of the transfer function is
    left out. An error that exceeds the width of the range that its field declares, as one of a colour above 1, becomes infinite: the
    images have not determined it.

    **Raises** `ValueError` where an error has not the shape of its field.
    """
    if isinstance(standard_errors, AbstractTransfer):
        standard_errors = vars(standard_errors)
    found = {}
    for name, error in (standard_errors or {}).items():
        field = name.removeprefix("transfer.")
        value = vars(transfer).get(field)
        if value is None or error is None:
            continue
        if np.shape(error) != np.shape(value):
            raise ValueError(f"the errors of {field} have shape {np.shape(error)}, its values {np.shape(value)}")
        found[field] = np.where(np.asarray(error) > _width(transfer, field), np.inf, error)
    return found


def _width(transfer: AbstractTransfer, field: str) -> float:
    """Of the range that a field declares."""
    declared = range_at(transfer, (jax.tree_util.GetAttrKey(field),))
    return declared.high - declared.low if isinstance(declared, Interval) else np.inf
