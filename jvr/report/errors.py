"""Which standard error belongs to which field of a transfer function."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jvr.model.transfer import AbstractTransfer


def field_errors(
    transfer: AbstractTransfer, standard_errors: Mapping[str, Any] | AbstractTransfer | None
) -> dict[str, np.ndarray]:
    """Standard errors by the name of the transfer function's field: `rgb`, `sigma_t`, `positions`, `height`, ...

    **Arguments:** `standard_errors`: a mapping from fields, called `"rgb"` or, as `FitResult.errors_by_name` does,
    `"transfer.rgb"`; or a transfer function that holds errors in place of values. What is not a field of the transfer function is
    left out. The error of a colour that exceeds 1 becomes infinite: colours end there, so the images have not determined it.

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
        error = np.asarray(error)
        found[field] = np.where(error > 1, np.inf, error) if field == "rgb" else error
    return found
