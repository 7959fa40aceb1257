"""Which standard error belongs to which field of a transfer function."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jvr.model.transfer import AbstractTransfer


def field_errors(transfer: AbstractTransfer, standard_errors: Any) -> dict[str, np.ndarray]:
    """Standard errors by the name of the transfer function's field: `rgb`, `sigma_t`, `positions`, `height`, ...

    **Arguments:** `standard_errors`: a mapping from fields (`"rgb"` or `"transfer.rgb"`), a transfer function that holds errors
    in place of values, or arrays in the structure that a fit's `unknowns` returned. Such arrays are told apart by their shapes:
    all fields in their order, else `rgb` first and then extinction, so pass a mapping where `positions`, `center` or `width` were
    fitted without the others. Arrays that fit no field are left out.
    """
    fields = {name: np.shape(value) for name, value in vars(transfer).items() if value is not None}
    if standard_errors is None:
        return {}
    if isinstance(standard_errors, AbstractTransfer):
        standard_errors = vars(standard_errors)
    if isinstance(standard_errors, Mapping):
        named = {name.rpartition(".")[2]: np.asarray(value) for name, value in standard_errors.items() if value is not None}
        return {name: value for name, value in named.items() if fields.get(name) == value.shape}
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(standard_errors)]
    if [array.shape for array in arrays] == list(fields.values()):
        return dict(zip(fields, arrays, strict=True))
    likely = ("rgb", "sigma_t", "height", *fields)
    found: dict[str, np.ndarray] = {}
    for array in arrays:
        name = next((name for name in likely if name not in found and fields.get(name) == array.shape), None)
        if name:
            found[name] = array
    return found
