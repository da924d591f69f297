"""Exponential, cosine and sine without branches or calls: a loop over them becomes vector instructions.

That is, those of single precision; those of double precision are the C library's. Reduction and polynomials
are Cephes's (S. L. Moshier; expf.c and sinf.c), its coefficients minimax on the reduced range.
"""

from __future__ import annotations

import math

import numpy as np

from system.compiled import by_precision

FAR = 100.0
"""`cos_sin` is for angles [rad] up to this."""

# 1.5 · 2^23: added to a number, leaves it rounded to a whole one, in the lowest bits of the sum.
_ROUNDER = np.float32(1.5 * 2**23)
_ROUNDER_BITS = _ROUNDER.view(np.int32)
_HALF, _WHOLE, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.int32(1), np.int32(2)

_LOWEST, _HIGHEST = np.float32(-104.0), np.float32(89.0)  # beyond, e^x is 0 or infinite
_PER_LN2 = np.float32(1.0 / math.log(2.0))
_LN2, _LN2_REST = np.float32(0.693359375), np.float32(-2.12194440e-4)
_BIAS, _FRACTION_BITS = np.int32(127), np.int32(23)
_EXP = tuple(
    np.float32(c)
    for c in (
        1.9875691500e-4,
        1.3981999507e-3,
        8.3334519073e-3,
        4.1665795894e-2,
        1.6666665459e-1,
        5.0000001201e-1,
    )
)

_PER_QUARTER = np.float32(2.0 / math.pi)
_QUARTER = tuple(
    np.float32(2.0 * part) for part in (0.78515625, 2.4187564849853515625e-4, 3.77489497744594108e-8)
)
_COS = tuple(np.float32(c) for c in (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2))
_SIN = tuple(np.float32(c) for c in (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1))


def _exp(x: np.float32) -> np.float32:
    """Of every x, within 1.5 units in the last place; beyond float32's range 0 or infinite, of NaN NaN."""
    x = _LOWEST if x < _LOWEST else x
    x = _HIGHEST if x > _HIGHEST else x
    rounded = np.float32(x * _PER_LN2 + _ROUNDER)
    power = rounded - _ROUNDER
    r = x - power * _LN2 - power * _LN2_REST
    p = ((((_EXP[0] * r + _EXP[1]) * r + _EXP[2]) * r + _EXP[3]) * r + _EXP[4]) * r + _EXP[5]
    # 2^power in two factors: one float32 has not the range.
    whole = np.int32(rounded.view(np.int32) - _ROUNDER_BITS)
    half = np.int32(whole >> _ONE)
    first = np.int32((half + _BIAS) << _FRACTION_BITS).view(np.float32)
    second = np.int32((whole - half + _BIAS) << _FRACTION_BITS).view(np.float32)
    return (p * r * r + r + _WHOLE) * first * second


def _cos_sin(x: np.float32) -> tuple[np.float32, np.float32]:
    """Cosine and sine within 1e-7, for |x| up to `FAR`."""
    rounded = np.float32(x * _PER_QUARTER + _ROUNDER)
    quarters = rounded - _ROUNDER
    r = x - quarters * _QUARTER[0] - quarters * _QUARTER[1] - quarters * _QUARTER[2]
    z = r * r
    cos = ((_COS[0] * z + _COS[1]) * z + _COS[2]) * z * z - _HALF * z + _WHOLE
    sin = ((_SIN[0] * z + _SIN[1]) * z + _SIN[2]) * z * r + r
    turned = rounded.view(np.int32)
    odd = (turned & _ONE) != 0
    cos, sin = (sin if odd else cos), (cos if odd else sin)
    cos = -cos if ((turned + _ONE) & _TWO) != 0 else cos
    sin = -sin if (turned & _TWO) != 0 else sin
    return cos, sin


def _exp_double(x: float) -> float:
    return math.exp(x)


def _cos_sin_double(x: float) -> tuple[float, float]:
    return math.cos(x), math.sin(x)


exp = by_precision(_exp, _exp_double)
cos_sin = by_precision(_cos_sin, _cos_sin_double)
