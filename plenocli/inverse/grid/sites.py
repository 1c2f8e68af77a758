"""Places of bright spots on the lattice of a white image."""

from __future__ import annotations

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.inverse.grid import lattice, spots
from plenocli.inverse.grid.white_image import FIX, in_frame

FAINT = 0.04
"""Of the typical light of a lenslet, below which a spot is noise of dark surroundings."""


def measured_sites(
    image: np.ndarray,
    basis: np.ndarray,
    kind: str,
    pitch: float,
    structured: bool,
    *,
    even: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Numbered centroids on the flattened image: index (N, 2), position (N, 2), clean (N,) bool,
    slope of the light (N, 2); lenslets that are not lit evenly are refused where `even`.
    """
    window = spots.WIDE_WINDOW if structured else spots.WINDOW
    maxima = spots.find_maxima(image, pitch, 0.28 if structured else 0.18)
    if len(maxima) < 9:
        raise NumericsError(
            (
                f"no lenslet lattice in the image: {len(maxima)} bright spots at a "
                f"pitch of {pitch:.1f} px"
            ),
            fix=FIX,
        )
    position, flux = spots.windowed_centroids(image, maxima, pitch, iterations=2, window=window)
    lit = flux > FAINT * typical_light(flux)
    position, flux = position[lit], flux[lit]
    middle = np.array(image.shape) / 2
    bright = np.flatnonzero(flux > 0.5 * np.median(flux))
    starts = bright[np.argsort(((position[bright] - middle) ** 2).sum(axis=1))]
    best, chosen = np.zeros(len(position), bool), None
    # a start on dust or a reflection strands the walk
    for start in starts[:: max(1, len(starts) // 6)][:6]:
        index, found = lattice.index_sites(position, basis, kind, start)
        if found.sum() > best.sum():
            best, chosen = found, index
        if best.sum() > 0.6 * len(position):
            break
    assert chosen is not None  # a walk finds its start at least
    index, first, flux = chosen[best], position[best], flux[best]
    surface, slope = _illumination(
        first, flux, image.shape, in_frame(first, image.shape, 0.45 * pitch)
    )
    slope = slope / np.maximum(surface, 1e-9)[:, None]
    level = flux / np.maximum(surface, 1e-9)
    spread = 1.48 * np.median(np.abs(level - np.median(level)))
    if even and spread > 0.1:  # real white images have 0.02 at most
        raise NumericsError(
            (
                f"no lenslet lattice in the image: patches repeat every {pitch:.1f} px, but their "
                f"brightness scatters by {100 * spread:.0f} % from one to the next (a chart or a "
                "scene, not even light)"
            ),
            fix=FIX,
        )
    return index, first, level > 0.3, slope


def parts_sites(
    image: np.ndarray, basis: np.ndarray, times: np.ndarray, *, even: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As measured_sites, of superpixels whose parts look alike: the first part of each, found
    where their lattice is square.

    basis: vectors [down, right] from part to part, of which `times` make a superpixel.
    """
    from scipy import ndimage

    side = float(np.hypot(*basis.T).min())
    to_image = basis / side
    corners = np.array(list(np.ndindex(2, 2))) * image.shape @ np.linalg.inv(to_image)
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    square = ndimage.affine_transform(
        image, to_image.T, low @ to_image, tuple((high - low).astype(int)), order=1
    )
    index, position, clean, slope = measured_sites(
        square, side * np.eye(2), "square", side, False, even=even
    )
    first = (index % times == 0).all(axis=1)
    position = (position[first] + low) @ to_image
    slope = slope[first] @ np.linalg.inv(to_image).T
    return index[first] // times, position, clean[first], slope


def typical_light(light: np.ndarray) -> float:
    """Median of what is not dark, as most of a frame may be beside a small array."""
    return float(np.median(light[light > 0.1 * np.quantile(light, 0.98)])) if light.size else 0.0


def _illumination(
    position: np.ndarray, flux: np.ndarray, shape: tuple[int, ...], whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth surface (order up to 4) through the fluxes of `whole` lenslets: values (N,) and
    gradients (N, 2) per px.
    """
    size = np.array(shape, float) / 2
    u = (position - size) / size
    use = whole if whole.sum() >= 9 else np.ones(len(u), bool)
    order = max(k for k in range(5) if k == 0 or use.sum() >= 2.5 * (k + 1) * (k + 2) / 2)
    powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    design = np.stack([u[:, 0] ** i * u[:, 1] ** j for i, j in powers], axis=1)
    weight = use.astype(float)
    for _ in range(4):
        fit = np.linalg.lstsq(design * weight[:, None], flux * weight, rcond=None)[0]
        miss = np.abs(flux - design @ fit)
        weight = use / np.maximum(1, miss / max(3 * np.median(miss[use]), 1e-12))
    down = (
        np.stack([i * u[:, 0] ** max(i - 1, 0) * u[:, 1] ** j for i, j in powers], axis=1)
        @ fit
        / size[0]
    )
    right = (
        np.stack([j * u[:, 0] ** i * u[:, 1] ** max(j - 1, 0) for i, j in powers], axis=1)
        @ fit
        / size[1]
    )
    surface = np.maximum(design @ fit, 0.05 * np.median(flux))
    return surface, np.stack([down, right], axis=1)
