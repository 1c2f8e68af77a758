"""Reconstruction of all lenslets together: the data of every lenslet, and a prior that sees the whole picture.

Half-quadratic splitting takes turns between  x = argmin |y - A x|^2/sigma^2 + |x - v|^2/tau^2  (the proximal step: in closed form
through the singular value decomposition of the own block, by conjugate gradients where neighbours' light counts) and a
denoiser, v = D(x, tau), of the whole picture, while tau falls ("plug and play": Venkatakrishnan, Bouman, Wohlberg, GlobalSIP
2013; the schedule as in Zhang et al., IEEE Trans. PAMI 44 (2022) 6360). Total variation is the convex case, by the
alternating direction method of multipliers (Boyd et al. 2011). A is block-Toeplitz over lenslets and never formed.
"""

import numpy as np

from plenocli.operators import BlockToeplitz, to_blocks, to_plane

FROM, TO, ROUNDS = 6.0, 0.1, 10
"""Plug and play: first and last tau over the error that is expected at the start, and rounds in between; chosen on validation
scenes (docs/model.md)."""
TV_WEIGHT, TV_ROUNDS = 1.0, 20
"""Total variation: its weight times the error expected at the start, and rounds of ADMM."""
TOLERANCE, MOST = 1e-4, 60
"""Conjugate gradients end at this residual, relative to the right-hand side, or after so many steps."""


class DataTerm:
    """|y - A x|^2/sigma^2 of a sensor, in the directions of the own block that can be seen.

    svd: of the own block A_0.  blocks (offset, pixel, point), offsets (offset, 2): as in BlockToeplitz.  object_shape: points
    (rows, columns) of a block.  y (lenslet_row, lenslet_column, pixel); sigma > 0: noise of a pixel.  contrast: what a point
    may differ from what the prior expects; left singular vectors whose signal is then below 3 % of the noise are dropped.
    Where neighbours count, objects one lenslet beyond the array are unknowns too, as their light falls into it: `ring` is 1.
    """

    def __init__(self, svd, blocks, offsets, object_shape, y, sigma, contrast=0.1):
        self.shape, self.sigma, self.ring = tuple(object_shape), float(sigma), int(np.abs(offsets).max(initial=0))
        kept = max(1, int(np.count_nonzero((svd.s * contrast) ** 2 > 1e-3 * sigma**2)))
        self.s, self.vt = svd.s[:kept], svd.vt[:kept]
        self.z = y @ svd.u[:, :kept]
        count = tuple(n + 2 * self.ring for n in y.shape[:2])
        self.inner = tuple(slice(self.ring, n - self.ring) for n in count)
        self.map = BlockToeplitz(np.stack([svd.u[:, :kept].T @ block for block in blocks]), offsets, count) if self.ring else None

    def extend(self, picture):
        """A picture of the array, (row, column), continued over the ring by its edge."""
        return np.pad(picture, [(self.ring * n, self.ring * n) for n in self.shape], mode="edge") if self.ring else picture

    def crop(self, picture):
        """The array's part of a picture with the ring."""
        r, c = (self.ring * n for n in self.shape)
        return picture[r : picture.shape[0] - r, c : picture.shape[1] - c]

    def proximal(self, picture, tau):
        """argmin over x of |y - A x|^2/sigma^2 + |x - picture|^2/tau^2, pictures (row, column) with the ring."""
        alpha = (self.sigma / tau) ** 2
        v = to_blocks(picture, self.shape)
        if not self.ring:
            step = ((self.z - (v @ self.vt.T) * self.s) * (self.s / (self.s**2 + alpha))) @ self.vt
        else:
            step = self._solve(self._adjoint(self.z - self._forward(v)), alpha)
        return to_plane(v + step, self.shape)

    def _forward(self, x):
        return self.map.forward(x)[self.inner]

    def _adjoint(self, z):
        full = np.zeros(self.map.range.shape)
        full[self.inner] = z
        return self.map.adjoint(full)

    def _solve(self, right, alpha):
        """(A^T A + alpha) step = right by conjugate gradients, preconditioned with the own block's inverse inside the array."""
        damp = self.s**2 / (self.s**2 + alpha)

        def precondition(r):
            out = r / alpha
            out[self.inner] -= (((r[self.inner] @ self.vt.T) * damp) @ self.vt) / alpha
            return out

        step, rest = np.zeros_like(right), right
        ahead = precondition(rest)
        way, power = ahead, np.vdot(rest, ahead)
        goal = TOLERANCE**2 * power
        for _ in range(MOST):
            if power <= goal:
                break
            image = self._adjoint(self._forward(way)) + alpha * way
            length = power / np.vdot(way, image)
            step, rest = step + length * way, rest - length * image
            ahead = precondition(rest)
            after = np.vdot(rest, ahead)
            way, power = ahead + (after / power) * way, after
        return step


def schedule(error):
    """Falling tau for `plug_and_play` from a picture whose root mean square error is expected to be `error`."""
    return np.geomspace(FROM * error, TO * error, ROUNDS)


def plug_and_play(term, start, denoise, taus):
    """The picture (row, column) after a round of v = denoise(x, tau), x = proximal(v, tau) for each tau, from x = start."""
    x = term.extend(start)
    for tau in taus:
        x = term.proximal(denoise(x, tau), tau)
    return term.crop(x)


def total_variation(term, start, error, *, rounds=TV_ROUNDS):
    """argmin |y - A x|^2/(2 sigma^2) + TV_WEIGHT/error TV(x), isotropic, by `rounds` of ADMM from x = start.

    error: root mean square error expected of `start`; it also scales the penalty, tau = error.
    """
    from skimage.restoration import denoise_tv_chambolle

    x = term.extend(start)
    dual = np.zeros_like(x)
    for _ in range(rounds):
        v = denoise_tv_chambolle(x + dual, weight=TV_WEIGHT * error, eps=1e-5, max_num_iter=60)
        dual = dual + x - v
        x = term.proximal(v - dual, error)
    return term.crop(v)
