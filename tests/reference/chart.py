"""A ColorChecker in perspective, from closed forms: where each pixel of the picture lies on the
chart, and uneven light.
"""

import csv

import numpy as np

from plenocli.forward.scene.tables import colorchecker

SHAPE = (200, 260)
# rows and columns of the picture, projectively
CHART = np.array([[34.0, 2.0, 14.0], [-1.5, 36.0, 20.0], [0.004, 0.006, 1.0]])


def place():
    """Chart coordinates (rows, columns, 2) of every pixel, by solving the two linear equations
    of the projection.
    """
    v, u = np.meshgrid(*(np.arange(n, dtype=float) for n in SHAPE), indexing="ij")
    h = CHART
    a, b = h[0, 0] - v * h[2, 0], h[0, 1] - v * h[2, 1]
    c, d = h[1, 0] - u * h[2, 0], h[1, 1] - u * h[2, 1]
    right, below = v - h[0, 2], u - h[1, 2]
    return (
        np.stack([d * right - b * below, a * below - c * right], axis=-1)
        / (a * d - b * c)[..., None]
    )


def label_map():
    """0 on the frame and beyond the chart, 1 to 24 on its patches."""
    y, x = np.moveaxis(place(), -1, 0)
    inside = (
        (np.abs(y % 1 - 0.5) < 0.42)
        & (np.abs(x % 1 - 0.5) < 0.42)
        & (y > 0)
        & (y < 4)
        & (x > 0)
        & (x < 6)
    )
    return np.where(inside, np.floor(y) * 6 + np.floor(x) + 1, 0).astype(int)


def light(degree2):
    """Illumination (rows, columns) whose logarithm has the coefficients `degree2` of v, u, v^2,
    u v, u^2, each from -1 to 1 over the picture.
    """
    v, u = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    return np.exp(degree2 @ np.array([v, u, v * v, u * v, u * u]).reshape(5, -1)).reshape(SHAPE)


BANDS = [450, 550, 650]
TIMES = {"25ms": 0.025, "250ms": 0.25, "2s": 2.0}
FIELDS = [
    [-0.1, -0.4, -0.05, 0.03, -0.1],
    [0.0, -0.3, 0.02, 0.0, -0.15],
    [0.05, -0.25, 0.0, -0.03, -0.1],
]
COLOURS = {"B": [1.0, 0.3, 0.02], "G": [0.2, 1.0, 0.1], "R": [0.03, 0.15, 1.0]}


def paint_folder(folder):
    """Captures, dark frames, label maps and spectra as files in `folder`: a GBRG camera with hot
    pixels, cut-off digits and saturation; a chart before paper with dots, under light that
    falls off by half.
    """
    from PIL import Image

    rng = np.random.default_rng(1)
    labels, wavelengths = label_map(), np.arange(380, 781, 2) * 1e-9
    names, _, spectra = colorchecker(wavelengths)
    y, x = np.moveaxis(place(), -1, 0)
    beyond = (y < -0.35) | (y > 4.35) | (x < -0.35) | (x > 6.35)
    dots = np.where(
        (np.arange(SHAPE[0])[:, None] % 9 < 3) & (np.arange(SHAPE[1]) % 9 < 3), 0.1, 0.85
    )
    hot = np.where(rng.uniform(size=SHAPE) < 0.002, 60.0, 0.0)  # DN/s
    (folder / "captures").mkdir()
    for k, band in enumerate(BANDS):
        reflectance = np.concatenate([[0.04], colorchecker([band * 1e-9])[2][:, 0]])[labels]
        scene = np.where(beyond, dots, reflectance) * light(np.array(FIELDS[k]))
        colours = np.tile(
            np.array([[COLOURS[c][k] for c in pair] for pair in ("GB", "RG")]),
            (SHAPE[0] // 2, SHAPE[1] // 2),
        )
        for name, seconds in TIMES.items():
            electrons = rng.poisson(20 * 900 * seconds * colours * scene)
            save(
                folder / "captures" / f"d2_chart_{band}nm_{name}_2019-02-18.tif",
                electrons / 20 + hot * seconds,
            )
    for name, seconds in TIMES.items():
        save(folder / f"dark_{name}.tif", hot * seconds)
    Image.fromarray(labels.astype(np.uint8)).save(folder / "labels.png")
    # not one to be taken
    Image.fromarray(np.where(labels > 0, 255, 0).astype(np.uint8)).save(
        folder / "a_labels_mask.png"
    )
    filters = [np.exp(-(((wavelengths * 1e9 - band) / 6) ** 2)) for band in BANDS]
    with open(folder / "spectra.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["Wavelength", *(f"{band} nm" for band in BANDS), *names])
        writer.writerows(np.column_stack([wavelengths * 1e9, *filters, *spectra]).round(9).tolist())
    return folder


def save(path, values):
    from PIL import Image

    Image.fromarray(np.clip(np.floor(values), 0, 255).astype(np.uint8)).save(path)
