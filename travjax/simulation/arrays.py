"""Converts arrays of any library, as callers pass them, to NumPy arrays of numbers.

Everything that NumPy reads as numbers is accepted: any number type and byte order, lists of rows or of maps, tensors,
tables. Masked and missing values, which NumPy's own conversion would lose, become NaN.
"""

import array
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import jax.numpy as jnp
import numpy as np

from travjax.config import InputError, require

NESTED = 8
"""Lists may be nested at most this deep."""


def numbers(name: str, values: Any, allowed: str = "numbers", depth: int = 0) -> np.ndarray:
    """Returns values on the host as numbers in the machine's byte order; masked and missing ones are NaN.

    name:    what errors call the values
    allowed: what errors say the values must be
    depth:   number of lists around the values
    Raises InputError when the values are not an array of numbers.
    """
    if _is_sequence(values):
        return _stacked(name, values, allowed, depth)
    try:
        found = np.asanyarray(_of_tensor(values) if hasattr(values, "detach") else values)
    except Exception as error:  # the conversion of another library's array may raise anything
        reason = str(error).partition("\n")[0]
        raise InputError(f"{name}: {type(values).__name__} cannot be read as an array: {reason}") from None
    mask = np.ma.getmaskarray(found) if np.ma.isMaskedArray(found) else _own_mask(values, found.shape)
    found = np.asarray(found)
    if found.dtype == object and found.ndim:
        found = _stacked(name, list(found), allowed, depth)
    elif found.dtype == object:
        found = np.asarray(_number(name, found.item(), allowed))
    if not are_numbers(found.dtype):
        raise InputError(f"{name}: dtype {found.dtype}: must be {allowed}")
    if mask is not None and mask.any():
        return np.where(mask, np.nan, found.astype(np.float64))
    return found.astype(found.dtype.newbyteorder("="), copy=False)


def integers(name: str, values: Any, allowed: str, least: int, most: int) -> np.ndarray:
    """Returns an array of integers from values of any kind, as `numbers` does.

    Raises InputError unless there is at least one value and all are integers from `least` to `most`.
    """
    try:
        found = numbers(name, values)
    except InputError:
        found = np.empty(0)
    whole = np.issubdtype(found.dtype, np.integer) and found.size > 0
    require(bool(whole and found.min() >= least and found.max() <= most), name, values, allowed)
    return found


def are_numbers(dtype: Any) -> bool:
    """Tells whether arrays of this type hold real numbers: not booleans, texts, times or complex numbers."""
    if isinstance(dtype, np.dtype):
        dtype = dtype.newbyteorder("=")
        if dtype.kind == "m":  # NumPy counts time spans as integers
            return False
    return jnp.issubdtype(dtype, jnp.number) and not jnp.issubdtype(dtype, jnp.complexfloating)


def _is_sequence(values: Any) -> bool:
    """Tells whether values are a sequence of parts to stack, rather than an array, a text or a table."""
    if isinstance(values, str | bytes | bytearray | memoryview | array.array):
        return False
    arrays = ("__array__", "__array_interface__", "__array_struct__", "keys")
    parts = ("__len__", "__getitem__")
    return all(hasattr(values, own) for own in parts) and not any(hasattr(values, own) for own in arrays)


def _stacked(name: str, parts: Sequence, allowed: str, depth: int) -> np.ndarray:
    if all(type(part) in (int, float) for part in parts):
        found = np.array(parts)
        if found.dtype != object:  # an object array: the integers are too large for any number type
            return found
    if depth == NESTED:
        raise InputError(f"{name}: lists {NESTED} deep: must be {allowed} in rows")
    arrays = [numbers(name, part, allowed, depth + 1) for part in parts]
    shapes = sorted({part.shape for part in arrays})
    if len(shapes) > 1:
        raise InputError(f"{name}: parts of shapes {list(shapes[0])} and {list(shapes[-1])}: must all have one shape")
    return np.stack(arrays)


def _of_tensor(tensor: Any) -> Any:
    """Converts a torch tensor, on any device and also of a type that NumPy lacks, to what NumPy can read."""
    host = tensor.detach().cpu()
    kind = str(host.dtype).removeprefix("torch.")
    return np.asarray(host.float()).astype(jnp.dtype(kind)) if kind.startswith(("bfloat", "float8")) else host


def _own_mask(values: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """Returns the mask (True where unknown) of an array of another library, or None where it has none."""
    mask = getattr(values, "mask", None)
    return mask if isinstance(mask, np.ndarray) and mask.dtype == bool and mask.shape == shape else None


def _number(name: str, value: Any, allowed: str) -> float:
    """Converts a single Python object to a number; None and the missing value of pandas become NaN."""
    if value is None or type(value).__name__ == "NAType":
        return np.nan
    number = None
    with suppress(TypeError, ValueError, OverflowError):
        number = float(value)
    require(number is not None, name, value, allowed)
    return number  # type: ignore[return-value]
