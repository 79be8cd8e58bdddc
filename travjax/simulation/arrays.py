"""Arrays as callers hand them over, whatever they are kept in, as NumPy arrays of numbers.

Whatever NumPy reads as numbers is taken: any number type and byte order, lists of rows or of maps, tensors, tables.
What it would lose on the way is kept: masked and missing values are NaN, and not what lies under the mask.
"""

import array
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import jax.numpy as jnp
import numpy as np

from travjax.config import InputError, require

NESTED = 8
"""Lists within lists, at most."""


def numbers(name: str, values: Any, allowed: str = "numbers", depth: int = 0) -> np.ndarray:
    """Returns values on the host as numbers in the machine's byte order; masked and missing ones are NaN.

    name, allowed: what an error calls them, and says that they must be; depth: of the lists that they are within
    Raises InputError for what is no array of numbers.
    """
    if _is_sequence(values):
        return _stacked(name, values, allowed, depth)
    try:
        found = np.asanyarray(_of_tensor(values) if hasattr(values, "detach") else values)
    except Exception as error:  # whatever the conversion of a foreign array raises
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
    """Returns values as `numbers` does.

    Raises InputError unless they are integers from `least` to `most`, one or more.
    """
    try:
        found = numbers(name, values)
    except InputError:
        found = np.empty(0)
    whole = np.issubdtype(found.dtype, np.integer) and found.size > 0
    require(bool(whole and found.min() >= least and found.max() <= most), name, values, allowed)
    return found


def are_numbers(dtype: Any) -> bool:
    """Whether arrays of this type hold real numbers: no truth values, texts, times or complex numbers."""
    if isinstance(dtype, np.dtype):
        dtype = dtype.newbyteorder("=")
        if dtype.kind == "m":  # spans of time are integers to NumPy
            return False
    return jnp.issubdtype(dtype, jnp.number) and not jnp.issubdtype(dtype, jnp.complexfloating)


def _is_sequence(values: Any) -> bool:
    """Whether these are parts that have to be put together, and not an array, a text or a table."""
    if isinstance(values, str | bytes | bytearray | memoryview | array.array):
        return False
    arrays = ("__array__", "__array_interface__", "__array_struct__", "keys")
    parts = ("__len__", "__getitem__")
    return all(hasattr(values, own) for own in parts) and not any(hasattr(values, own) for own in arrays)


def _stacked(name: str, parts: Sequence, allowed: str, depth: int) -> np.ndarray:
    if all(type(part) in (int, float) for part in parts):
        found = np.array(parts)
        if found.dtype != object:  # of integers that no array holds
            return found
    if depth == NESTED:
        raise InputError(f"{name}: lists {NESTED} deep: must be {allowed} in rows")
    arrays = [numbers(name, part, allowed, depth + 1) for part in parts]
    shapes = sorted({part.shape for part in arrays})
    if len(shapes) > 1:
        raise InputError(f"{name}: parts of shapes {list(shapes[0])} and {list(shapes[-1])}: must all have one shape")
    return np.stack(arrays)


def _of_tensor(tensor: Any) -> Any:
    """A tensor of torch as NumPy takes it, wherever it lies, and of a type that NumPy lacks as well."""
    host = tensor.detach().cpu()
    kind = str(host.dtype).removeprefix("torch.")
    return np.asarray(host.float()).astype(jnp.dtype(kind)) if kind.startswith(("bfloat", "float8")) else host


def _own_mask(values: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """The mask, True where unknown, of an array that carries one and is not NumPy's own."""
    mask = getattr(values, "mask", None)
    return mask if isinstance(mask, np.ndarray) and mask.dtype == bool and mask.shape == shape else None


def _number(name: str, value: Any, allowed: str) -> float:
    """A single object of Python; None and what pandas has for missing are NaN."""
    if value is None or type(value).__name__ == "NAType":
        return np.nan
    number = None
    with suppress(TypeError, ValueError, OverflowError):
        number = float(value)
    require(number is not None, name, value, allowed)
    return number  # type: ignore[return-value]
