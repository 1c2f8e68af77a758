"""Bessel functions of many orders at many places, by recurrence."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

LEAST = 1e-14
"""Arguments below are taken for this one: J0 there is 1 to rounding, and its recurrence ends."""


def bessel_tail(largest: float, error: float) -> int:
    """Order beyond which Bessel functions of arguments up to `largest` stay below `error`.

    Beyond the turning point they fall as Airy's function of 2^(1/3) (m - x)/x^(1/3)
    (Abramowitz and Stegun 9.3.4).
    """
    digits = max(1.0, -math.log(error) - 3)
    return math.ceil(largest + (1.5 * digits) ** (2 / 3) * (largest / 2) ** (1 / 3) + 2)


def bessel_orders(
    orders: int, places: np.ndarray, dtype: np.typing.DTypeLike = float
) -> np.ndarray:
    """J_m(x) for m = 0 ... orders - 1, to 1e-13.

    places: x of any shape, none negative;
    dtype: of the result.

    Returns (orders, *places.shape).
    Miller's algorithm: the recurrence downwards, from orders where J_m is nothing, normalised by
    J_0 + 2 J_2 + 2 J_4 + ... = 1 (Abramowitz and Stegun 9.1.27, 9.1.46).
    """
    x = np.maximum(places.ravel(), LEAST)
    # where J_m is about 1e-13
    first = np.ceil(x + 10 * np.cbrt(x) + 16).astype(int)
    total = np.zeros_like(x)
    for m, values in _downwards(x, first, np.full_like(x, 1e-30)):
        if m % 2 == 0:
            total += values if m == 0 else 2 * values
    out = np.zeros((orders, x.size), dtype)
    for m, values in _downwards(x, first, 1e-30 / total):
        if m < orders:
            out[m] = values
    return out.reshape(orders, *places.shape)


def _downwards(
    x: np.ndarray, first: np.ndarray, start: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """(order, what is `start` at the order `first` and obeys the recurrence below it)."""
    above, here, twice = np.zeros_like(x), np.zeros_like(x), 2 / x
    for m in range(int(first.max()), -1, -1):
        here, above = twice * (m + 1) * here - above, here
        begin = first == m
        here[begin] = start[begin]
        yield m, here
