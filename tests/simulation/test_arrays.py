"""Arrays as callers hand them over: the right numbers, masks kept, or one line."""

import array
from collections import deque
from decimal import Decimal
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

from travjax.config import InputError
from travjax.simulation.arrays import integers, numbers

PLAIN = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
MASK = np.array([[False, True, False], [False, False, False]])
UNKNOWN = np.where(MASK, np.nan, PLAIN)
MASKED = np.ma.masked_array(np.where(MASK, -9999.0, PLAIN), MASK)


class Wrapped:
    """An array of another library, which NumPy converts."""

    def __init__(self, inner):
        self.inner = inner

    def __array__(self, dtype=None, copy=None):
        return self.inner


class WithMask(Wrapped):
    """One that carries a mask that NumPy does not know."""

    mask = MASK


class Rows:
    """A sequence that is no list."""

    def __len__(self):
        return 2

    def __getitem__(self, row):
        return MASKED[range(2)[row]]


class NAType:
    """As pandas writes a missing value."""

    def __float__(self):
        raise TypeError("float() argument must be a number, not NAType")


class Broken:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("lies on a device\nthat is far away")


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.int8, np.int64, np.uint16, jnp.bfloat16])
@pytest.mark.parametrize("order", ["=", ">", "<"])
def test_numbers_of_any_type_and_byte_order_keep_their_values(kind, order):
    given = PLAIN.astype(np.dtype(kind).newbyteorder(order))
    found = numbers("it", given)
    assert found.dtype == np.dtype(kind) and found.dtype.isnative
    np.testing.assert_array_equal(found.astype(float), PLAIN)


@pytest.mark.parametrize(
    "given",
    [
        PLAIN.tolist(),
        [tuple(row) for row in PLAIN],
        list(PLAIN),
        (PLAIN[0], PLAIN[1].tolist()),
        deque(PLAIN),
        [array.array("d", row) for row in PLAIN],
        memoryview(PLAIN),
        Wrapped(PLAIN),
        jnp.asarray(PLAIN),
        list(jnp.asarray(PLAIN)),
        PLAIN.astype(object),
        [[Decimal(1), 2, Fraction(3)], [4.0, np.int8(5), jnp.float32(6)]],
        [range(1, 4), range(4, 7)],
    ],
    ids=lambda given: type(given).__name__,
)
def test_arrays_of_any_kind_are_taken(given):
    found = numbers("it", given)
    assert type(found) is np.ndarray
    np.testing.assert_array_equal(found, PLAIN)


@pytest.mark.parametrize(
    "given",
    [
        MASKED,
        MASKED.astype(">f4"),
        MASKED.astype(int),
        list(MASKED),
        tuple(MASKED),
        [[1.0, np.ma.masked, 3.0], [4.0, 5.0, 6.0]],
        Rows(),
        Wrapped(MASKED),
        WithMask(MASKED.data),
        MASKED.astype(object),
        [[1.0, None, 3], [4, 5, 6]],
        [[1.0, NAType(), 3], [4, 5, 6]],
        np.array([[1.0, NAType(), 3], [4, 5, 6]], object),
    ],
)
def test_what_is_masked_or_missing_is_nan(given):
    np.testing.assert_array_equal(numbers("it", given), UNKNOWN)


def test_masks_within_lists_of_several_arrays_are_kept():
    np.testing.assert_array_equal(numbers("it", [MASKED, PLAIN, WithMask(PLAIN)]), [UNKNOWN, PLAIN, UNKNOWN])
    np.testing.assert_array_equal(numbers("it", [[MASKED], [MASKED]]), [[UNKNOWN], [UNKNOWN]])


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float32", "float64", "int16", "uint8"])
def test_tensors_are_taken(kind):
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(PLAIN).to(getattr(torch, kind))
    if tensor.is_floating_point():
        tensor.requires_grad_()
    for given in (tensor, list(tensor)):
        found = numbers("it", given)
        assert found.dtype.name == kind
        np.testing.assert_array_equal(found.astype(float), PLAIN)


def test_a_tensor_without_numbers_is_refused():
    torch = pytest.importorskip("torch")
    for wrong in (
        torch.zeros(2, dtype=torch.bool),
        torch.zeros(2, dtype=torch.complex64),
        torch.zeros(2, device="meta"),
    ):
        with pytest.raises(InputError, match="^it: .*[^\n]$"):
            numbers("it", wrong)


def itself() -> list:
    made: list = []
    made.append(made)
    return made


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("1.5", "it: dtype <U3: must be numbers"),
        (b"1.5", r"it: dtype \|S3: must be numbers"),
        (["1.5", 2.0], "it: dtype <U3: must be numbers"),
        ([None, "high"], "it: dtype <U4: must be numbers"),
        ([True, 2.0], "it: dtype bool: must be numbers"),
        (np.array([1, 2j], object), "it: dtype complex128: must be numbers"),
        (np.zeros(2, "timedelta64[s]"), r"it: dtype timedelta64\[s\]: must be numbers"),
        (np.zeros(2, "datetime64[s]"), r"it: dtype datetime64\[s\]: must be numbers"),
        (np.zeros(2, [("z", float)]), r"it: dtype \[\('z', '<f8'\)\]: must be numbers"),
        ([[1, 2], [3]], r"it: parts of shapes \[1\] and \[2\]: must all have one shape"),
        ([1, [2, 3]], r"it: parts of shapes \[\] and \[2\]: must all have one shape"),
        ([MASKED, PLAIN[0]], r"it: parts of shapes \[2, 3\] and \[3\]: must all have one shape"),
        ({"z": PLAIN}, "it = .*: must be numbers"),
        ((row for row in PLAIN), "it = <generator .*: must be numbers"),
        ([10**400], "it = .*: must be numbers"),
        (object(), "it = <object .*: must be numbers"),
        (itself(), "it: lists 8 deep: must be numbers in rows"),
        (Broken(), "it: Broken cannot be read as an array: lies on a device"),
    ],
)
def test_what_is_no_array_of_numbers_is_refused_in_one_line(wrong, said):
    with pytest.raises(InputError, match=f"^{said}$") as refusal:
        numbers("it", wrong)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("given", [3, np.int8(3), [1, 2], np.array([0, 9], ">i8"), range(10), jnp.arange(3)])
def test_integers_are_taken(given):
    np.testing.assert_array_equal(integers("it", given, "small", 0, 9), np.asarray(given))


@pytest.mark.parametrize(
    "wrong", [3.0, "3", True, None, [], [[1], [2, 3]], [1, 10], -1, np.ma.masked_array([1], [True])]
)
def test_what_is_no_integer_is_refused(wrong):
    with pytest.raises(InputError, match="(?s)^it = .*: must be small$"):
        integers("it", wrong, "small", 0, 9)
