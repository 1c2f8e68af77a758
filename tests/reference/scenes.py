"""Scenes that are no photographs, under any camera: what goes on nowhere, or in step with the
lenslets. Used to look for right matrices that are not believed.
"""

import numpy as np


def scenes(points: int, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Scenes by name, (row, column) from 0 to 1.

    points: of a lenslet, a side.
    count: lenslets, a side.
    """
    rng, side = np.random.default_rng(seed), points * count
    return _checked(points, side) | _drawn(side, rng) | _lit(points, count, rng)


def _checked(points, side):
    """Chessboards, and stripes with the lenslets' pitch about."""
    i, j = np.indices((side, side))
    made = {}
    for size in sorted({1, 2, 3, 4, 5, 7, points // 2, points, 2 * points}):
        made[f"chessboard, squares of {size}"] = (i // size + j // size) % 2 + 0.0
    made["grey chessboard"] = 0.3 + 0.4 * ((i // 4 + j // 4) % 2)
    made["faint chessboard"] = 0.5 + 0.02 * ((i // 4 + j // 4) % 2)
    turned = np.floor((0.9 * i + 0.43 * j) / 4) + np.floor((0.9 * j - 0.43 * i) / 4)
    made["turned chessboard"] = turned % 2
    for share in (1 / 3, 1 / 2, 0.9, 1, 2):
        made[f"stripes of {share:.2g} lenslets"] = (j % (share * points) < share * points / 2) + 0.0
    made["sine of a lenslet"] = 0.5 + 0.5 * np.sin(2 * np.pi * j / points)
    made["saw of a lenslet"] = (j % points) / (points - 1)
    made["bricks"] = 1 - 0.8 * ((i % 8 == 0) | ((j + 6 * (i // 8 % 2)) % 12 == 0))
    return made


def _drawn(side, rng):
    """Letters, stars, noise and charts."""
    i, j = np.indices((side, side))
    text = np.ones((side, side))
    for row in range(2, side - 9, 10):
        for column in range(2, side - 6, 6):
            text[row : row + 7, column : column + 5] -= 0.95 * (rng.random((7, 5)) < 0.45)
    sky = np.zeros((side, side))
    many = rng.integers(0, side, (2, side * side // 150))
    sky[tuple(many)] = rng.random(many.shape[1]) ** 3
    few = np.zeros((side, side))
    few[tuple(rng.integers(0, side, (2, 5)))] = 1
    angle = np.arctan2(i - side / 2 + 0.5, j - side / 2 + 0.5)
    square = (i - side / 2) ** 2 + (j - side / 2) ** 2
    frequency = np.fft.fftfreq(side)
    slope = np.maximum(np.hypot(frequency[:, None], frequency), 1 / side) ** 0.5
    flat = np.fft.ifft2(np.fft.fft2(rng.standard_normal((side, side))) / slope).real
    return {
        "letters": text,
        "stars": sky,
        "five stars": few,
        "Siemens star": (np.sin(18 * angle) > 0) + 0.0,
        "fine Siemens star": 0.5 + 0.5 * np.sin(60 * angle),
        "zone plate": 0.5 + 0.5 * np.cos(np.pi * square / (5 * side)),
        "noise": rng.random((side, side)),
        "black and white noise": (rng.random((side, side)) < 0.5) + 0.0,
        "noise of a flat spectrum": np.clip(0.5 + 0.15 * flat / flat.std(), 0, 1),
    }


def _lit(points, count, rng):
    """Light here and none there."""
    side, middle = points * count, points * (count // 2)
    i, j = np.indices((side, side))
    inside = slice(middle, middle + points)
    one, noisy = np.zeros((2, side, side))
    one[inside, inside] = 1
    noisy[inside, inside] = rng.random((points, points))
    return {
        "one bright lenslet": one,
        "one lenslet of noise": noisy,
        "half black": (j >= side // 2) + 0.0,
        "half black within lenslets": (j >= side // 2 + points // 3) + 0.0,
        "gradient": (i + 2 * j) / (3 * side),
        "steep gradient": np.clip((j - side / 2) / points + 0.5, 0, 1),
        "even": np.full((side, side), 0.5),
    }
