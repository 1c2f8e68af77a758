"""Reconstruction of all lenslets together: the data of every lenslet, and a prior that sees
the whole picture.

Half-quadratic splitting takes turns between x = argmin |y - A x|^2/sigma^2 + |x - v|^2/tau^2 (the
proximal step, in closed form through the singular value decomposition of the own block) and a
denoiser, v = D(x, tau), of the whole picture, while tau falls ("plug and play": Venkatakrishnan,
Bouman, Wohlberg, GlobalSIP 2013; the schedule as in Zhang et al., IEEE Trans. PAMI 44 (2022) 6360).
Total variation is the convex case, by the alternating direction method of multipliers
(Boyd et al. 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from itertools import count

import numpy as np

from plenocli.base.device import Device, beside, namespace
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture.solvers.least_squares import Svd

FROM, TO, ROUNDS = 6.0, 0.1, 10
"""Plug and play: first and last tau over the error that is expected at the start, and rounds in
between; chosen on validation scenes (docs/model.md).
"""
REMATCH = 2
"""Rounds that take the same patches for alike: the picture hardly changes in between (four
photographs at 30 and 50 dB: -0.02 to 0.05 dB).
"""
TV_WEIGHT, TV_ROUNDS = 0.2, 20
"""Total variation: its weight times the error expected at the start, and rounds of ADMM."""

Denoise = Callable[[np.ndarray, float], np.ndarray]
"""(picture, standard deviation of its noise) -> picture."""

Held = tuple[np.ndarray, np.ndarray]
"""(mask (lenslet_row, lenslet_column), objects (lenslet_row, lenslet_column, point)) of lenslets
whose light is not their own: their objects stay what they are.
"""


class DataTerm:
    """|y - A x|^2/sigma^2 of a sensor, in the directions of the own block that can be seen."""

    def __init__(
        self,
        svd: Svd,
        object_shape: tuple[int, int],
        y: np.ndarray,
        sigma: float,
        contrast: float = 0.1,
        held: Held | None = None,
    ) -> None:
        """For one capture.

        svd: of the own block.
        object_shape: points (rows, columns) of a block in one band.
        y: (lenslet_row, lenslet_column, pixel) own light, neighbours' taken away.
        sigma: noise of a pixel, > 0.
        contrast: what a point may differ from what the prior expects; singular vectors whose signal
            is then below 3 % of the noise are dropped.
        held: lenslets that stay what they are.
        """
        self.shape, self.sigma, self.held = object_shape, float(sigma), held
        kept = max(1, int(np.count_nonzero((svd.s * contrast) ** 2 > 1e-3 * sigma**2)))
        self.s, self.vt, self.z = svd.s[:kept], svd.vt[:kept], y @ svd.u[:, :kept]

    def on(self, device: Device) -> DataTerm:
        """The same for pictures that are on a device."""
        there = copy(self)
        there.s, there.vt, there.z = (device.put(one) for one in (self.s, self.vt, self.z))
        if self.held is not None:
            there.held = device.put(self.held[0]), device.put(self.held[1])
        return there

    def proximal(self, picture: np.ndarray, tau: float) -> np.ndarray:
        """argmin over x of |y - A x|^2/sigma^2 + |x - picture|^2/tau^2, pictures (row, column)
        or (band, row, column).
        """
        xp, v = namespace(picture), to_blocks(picture, self.shape)
        share = self.s / (self.s**2 + (self.sigma / tau) ** 2)
        seen = v @ xp.permute_dims(self.vt, (1, 0))
        x = v + ((self.z - seen * self.s) * share) @ self.vt
        if self.held is not None:
            mask, known = self.held
            x = xp.where(mask[:, :, None], known, x)
        return to_plane(x, self.shape)


def schedule(error: float) -> np.ndarray:
    """Falling tau for `plug_and_play` from a picture whose root mean square error is
    expected to be `error`.
    """
    return np.geomspace(FROM * error, TO * error, ROUNDS)


def denoiser(bands: np.ndarray) -> Denoise:
    """Block matching for pictures (row, column), or (band, row, column) whose bands have the
    covariance `bands` (band, band): these are turned into uncorrelated ones, most of them nearly
    flat, which leaves white noise white.
    """
    from plenocli.inverse.picture.solvers.block_matching import Matched, block_matching

    rounds, alike = count(), [Matched() for _ in bands]

    def denoise(picture: np.ndarray, tau: float) -> np.ndarray:
        if next(rounds) % REMATCH == 0:
            for matched in alike:
                matched.clear()
        if picture.ndim == 2:
            return block_matching(picture, tau, matched=alike[0])
        xp, turn = namespace(picture), beside(picture, np.linalg.eigh(bands)[1])
        turned = xp.tensordot(xp.permute_dims(turn, (1, 0)), picture, axes=1)
        planes = ((turned[k, :, :], matched) for k, matched in enumerate(alike))
        found = [block_matching(plane, tau, matched=matched) for plane, matched in planes]
        return xp.tensordot(turn, xp.stack(found), axes=1)

    return denoise


def plug_and_play(
    term: DataTerm, start: np.ndarray, denoise: Denoise, taus: Iterable[float]
) -> np.ndarray:
    """The picture after a round of v = denoise(x, tau), x = term.proximal(v, tau) for each tau.

    term: what the data say, on the device of `start`.
    denoise: of a picture and the standard deviation of its noise.
    start: the first x, (row, column) or (band, row, column).
    taus: falling, see `schedule`.
    """
    x = start
    for tau in map(float, taus):
        x = term.proximal(denoise(x, tau), tau)
    return x


def total_variation(
    term: DataTerm, start: np.ndarray, error: float, rounds: Iterable[int] = range(TV_ROUNDS)
) -> np.ndarray:
    """argmin |y - A x|^2/(2 sigma^2) + TV_WEIGHT/error TV(x), isotropic, by ADMM.

    term: what the data say.
    start: the first x, (row, column) or (band, row, column).
    error: root mean square error expected of it; it also scales the penalty, tau = error.
    rounds: one a round.
    """
    from skimage.restoration import denoise_tv_chambolle

    def flatter(picture: np.ndarray) -> np.ndarray:
        return denoise_tv_chambolle(picture, weight=TV_WEIGHT * error, eps=1e-5, max_num_iter=60)

    x = start
    dual = np.zeros_like(x)
    for _ in rounds:
        v = flatter(x + dual) if x.ndim == 2 else np.stack([flatter(plane) for plane in x + dual])
        dual = dual + x - v
        x = term.proximal(v - dual, error)
    return v
