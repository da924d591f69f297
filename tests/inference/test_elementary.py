"""Exponential, cosine and sine of compiled code against numpy's in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from inference.elementary import FAR, cos_sin, exp
from system.compiled import compiled


@compiled
def exponentials(numbers: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(numbers)):
        out[i] = exp(numbers[i])


@compiled
def cosines_and_sines(angles: np.ndarray, cosines: np.ndarray, sines: np.ndarray) -> None:
    for i in range(len(angles)):
        cosines[i], sines[i] = cos_sin(angles[i])


def exponentials_of(numbers: np.ndarray) -> np.ndarray:
    out = np.empty_like(numbers)
    exponentials(numbers, out)
    return out


def of_every_exponent() -> np.ndarray:
    """float32s of both signs, a hundred to each power of two, subnormal ones among them."""
    bits = np.arange(0, 0x7F800000, 2**23 // 100 + 7, dtype=np.uint32)
    sizes = bits.view(np.float32)
    return np.concatenate([sizes, -sizes])


def test_exponential_is_numpys_within_two_units_in_the_last_place() -> None:
    numbers = np.concatenate([np.linspace(-110, 95, 2_000_003, dtype=np.float32), of_every_exponent()])
    found = exponentials_of(numbers)
    with np.errstate(over="ignore"):
        exact = np.exp(numbers.astype(np.float64))
        nearest = exact.astype(np.float32)
    np.testing.assert_array_equal(np.isinf(found), np.isinf(nearest))
    finite = np.isfinite(nearest)
    unit = np.spacing(nearest[finite]).astype(np.float64)
    assert (np.abs(found[finite] - exact[finite]) / unit).max() < 1.5
    assert (found >= 0).all()


@pytest.mark.parametrize(
    ("x", "expected"), [(0.0, 1.0), (-0.0, 1.0), (-np.inf, 0.0), (np.inf, np.inf), (np.nan, np.nan)]
)
def test_exponential_of_the_ends_and_of_no_number(x: float, expected: float) -> None:
    # As many as fill vectors, and some over.
    np.testing.assert_array_equal(exponentials_of(np.full(67, x, np.float32)), np.full(67, expected))


def test_cosine_and_sine_are_numpys() -> None:
    small = of_every_exponent()
    angles = np.concatenate(
        [np.linspace(-FAR, FAR, 2_000_003, dtype=np.float32), small[np.abs(small) <= FAR]]
    )
    cosines, sines = np.empty_like(angles), np.empty_like(angles)
    cosines_and_sines(angles, cosines, sines)
    for found, expected in ((cosines, np.cos), (sines, np.sin)):
        assert np.abs(found - expected(angles.astype(np.float64))).max() < 1e-7
    assert max(np.abs(cosines).max(), np.abs(sines).max()) <= 1.0
    near = np.abs(angles) < 1e-3
    np.testing.assert_array_equal(cosines[angles == 0], 1.0)
    np.testing.assert_allclose(sines[near], np.sin(angles[near].astype(np.float64)), rtol=2e-7, atol=1e-45)


def test_in_double_precision_they_are_the_c_librarys() -> None:
    numbers = np.linspace(-700.0, 700.0, 1001)
    cosines, sines = np.empty_like(numbers), np.empty_like(numbers)
    cosines_and_sines(numbers, cosines, sines)
    np.testing.assert_allclose(exponentials_of(numbers), np.exp(numbers), rtol=1e-15)
    np.testing.assert_allclose(cosines, np.cos(numbers), rtol=0, atol=1e-15)
    np.testing.assert_allclose(sines, np.sin(numbers), rtol=0, atol=1e-15)
