"""Structural similarity of two images and its gradient in one compiled pass.

Both blurs go along rows first. A row of an image, three channels a pixel, lies in a line with room at both
ends, so that a register of neighbours is read from anywhere in it and what is outside the image is zero.
"""

import numpy as np
from jaxtyping import Float32

from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, broadcast, load, reduce_add, store

REACH, SIGMA = 5, 1.5
_MARGIN, _ROWS = 3 * REACH, 2 * REACH + 2
_WINDOW = np.exp(-(np.arange(REACH + 1) ** 2) / (2 * SIGMA**2))
_WINDOW = (_WINDOW / (2 * _WINDOW.sum() - _WINDOW[0])).astype(np.float32)
"""The window's weights from its centre outwards."""
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


def similarity(
    image: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"]
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """Return the mean structural similarity of two images in [0, 1], and its gradient by the first."""
    return _similarity(np.ascontiguousarray(image), np.ascontiguousarray(truth), _WINDOW)


@kernel
def _similarity(image, truth, window):
    """Go down the images once: blur a line, compare REACH lines above it, and collect as far above that.

    Of blurred lines only those that a blur across still wants are kept, so that all stays in the cache.
    """
    height, n = image.shape[0], 3 * image.shape[1]
    x, y, gradient = image.reshape(-1), truth.reshape(-1), np.empty(image.shape, np.float32)
    flat, count = gradient.reshape(-1), -(-n // LANES) * LANES
    stride = count + 2 * _MARGIN
    lines = np.zeros((4, stride), np.float32)
    blurred, derivatives = (
        np.zeros((4, _ROWS * stride), np.float32),
        np.zeros((3, _ROWS * stride), np.float32),
    )
    rows, inside = np.empty(2 * REACH + 1, np.uint64), np.zeros(count, np.float32)
    inside[:n] = _ONE / (height * n)
    total = 0.0
    for row in range(height + 2 * REACH):
        if row < height:
            lines[:, _MARGIN + n :] = 0
            for i in range(n):
                u, v = x[row * n + i], y[row * n + i]
                lines[0, _MARGIN + i], lines[1, _MARGIN + i] = u, v
                lines[2, _MARGIN + i], lines[3, _MARGIN + i] = u * u + v * v, u * v
            _blur_along(lines, blurred, row, count, stride, 4, window)
        middle = row - REACH
        if 0 <= middle < height:
            _find_rows(rows, middle, height, stride)
            total += _compare(blurred, lines, rows, inside, window)
            _blur_along(lines, derivatives, middle, count, stride, 3, window)
        top = row - 2 * REACH
        if top >= 0:
            _find_rows(rows, top, height, stride)
            for i in range(0, count, LANES):
                for k in range(3):
                    store(lines[k], np.uint64(_MARGIN + i), _across(derivatives[k], rows, i, window))
            for i in range(n):
                at = top * n + i
                by_x, by_squares, by_product = (
                    lines[0, _MARGIN + i],
                    lines[1, _MARGIN + i],
                    lines[2, _MARGIN + i],
                )
                flat[at] = by_x + _TWO * x[at] * by_squares + y[at] * by_product
    return total, gradient


@inlined
def _compare(blurred, lines, rows, inside, window):
    """Return a row's share of the similarity; write derivatives by blurred x, x² + y² and x y to lines."""
    sums = broadcast(_ZERO)
    for i in range(0, len(inside), LANES):
        weight = load(inside, np.uint64(i))
        u, v = _across(blurred[0], rows, i, window), _across(blurred[1], rows, i, window)
        squares, product = _across(blurred[2], rows, i, window), _across(blurred[3], rows, i, window)
        a, b = _TWO * u * v + _C1, _TWO * (product - u * v) + _C2
        c, d = u * u + v * v + _C1, squares - u * u - v * v + _C2
        per_c, per_d = _ONE / c, _ONE / d
        score = weight * a * b * per_c * per_d
        sums += score
        by_x = weight * v * (b - a) * per_c * per_d + u * score * (per_d - per_c)
        store(lines[0], np.uint64(_MARGIN + i), _TWO * by_x)
        store(lines[1], np.uint64(_MARGIN + i), -(score * per_d))
        store(lines[2], np.uint64(_MARGIN + i), _TWO * weight * a * per_c * per_d)
    return reduce_add(sums)


@inlined
def _find_rows(rows, center, height, stride):
    """Write where the rows around one are kept; those outside the image are the last one's zeros."""
    for k in range(2 * REACH + 1):
        row = center + k - REACH
        rows[k] = (row % (_ROWS - 1) if 0 <= row < height else _ROWS - 1) * stride + _MARGIN


@inlined
def _blur_along(lines, planes, row, count, stride, number, window):
    """Blur some lines along themselves into a row of as many planes. The blur is its own transpose."""
    first = row % (_ROWS - 1) * stride + _MARGIN
    for k in range(number):
        line = lines[k]
        for i in range(_MARGIN, _MARGIN + count, LANES):
            total = window[0] * load(line, np.uint64(i))
            for tap in range(1, REACH + 1):
                left, right = load(line, np.uint64(i - 3 * tap)), load(line, np.uint64(i + 3 * tap))
                total += window[tap] * (left + right)
            store(planes[k], np.uint64(first + i - _MARGIN), total)


@inlined
def _across(plane, rows, start, window):
    """Return the blur across rows of the LANES values from `start` on."""
    total = window[0] * load(plane, rows[REACH] + np.uint64(start))
    for tap in range(1, REACH + 1):
        above, below = rows[REACH - tap] + np.uint64(start), rows[REACH + tap] + np.uint64(start)
        total += window[tap] * (load(plane, above) + load(plane, below))
    return total
