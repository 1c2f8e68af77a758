"""Whether a linear map and its adjoint belong together."""

import numpy as np

from plenocli.base.linear_maps import BlockCirculant, BlockToeplitz, Space


class Dense:
    """y = A x for one matrix A (pixel, point)."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = np.asarray(matrix)
        self.dtype = self.matrix.dtype
        self.range = Space(("pixel",), self.matrix.shape[:1])
        self.domain = Space(("point",), self.matrix.shape[1:])

    def forward(self, x: np.ndarray) -> np.ndarray:
        """(point,) -> (pixel,): A x."""
        return self.matrix @ np.reshape(x, self.domain.shape)

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """(pixel,) -> (point,): A^T y."""
        return self.matrix.T @ np.reshape(y, self.range.shape)


def adjoint_gap(op: BlockCirculant | BlockToeplitz, seed: int = 0) -> float:
    """|<Ax, y> - <x, A*y>| in units of eps, for a seeded pair x, y.

    op: the map.
    seed: of x and y.

    Returns about 1-10 for a correct pair of forward and adjoint, at any shape and scale.

    Divided by |Ax| |y| / sqrt(size of y), not by the inner product itself, which may be near zero
    by chance. An adjoint that is wrong by 0.1 % gives hundreds (float32) or more, so 100
    separates right from wrong.
    """
    rng = np.random.default_rng(seed)
    x, y = (rng.standard_normal(s.shape).astype(op.dtype) for s in (op.domain, op.range))
    ax, aty = op.forward(x), op.adjoint(y)
    scale = np.linalg.norm(ax) * np.linalg.norm(y) / np.sqrt(y.size)
    if scale == 0:
        return 0.0 if not np.any(aty) else float("inf")
    return float(abs(np.vdot(ax, y) - np.vdot(x, aty)) / (np.finfo(op.dtype).eps * scale))
