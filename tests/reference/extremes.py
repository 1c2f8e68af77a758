"""How stable the solvers are: what their answers violate of their own equations, in units
of rounding errors.

As in LAPACK's tests, a backward stable method stays below about 30: |residual| / (eps
|A| (|A| |x| + |y|)).
"""

from pathlib import Path

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.files.config.camera_file import load_camera
from plenocli.forward.accuracy.dial import system_matrix
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.picture.solvers import lmmse, nnls
from plenocli.inverse.sparse.l1.solve import sparse_code
from plenocli.inverse.spectra import demultiplex as spectral

SAMPLES = Path(__file__).resolve().parents[2] / "sample_configs"
EPS = np.finfo(float).eps
SIZES = ((1, 1), (2, 1), (3, 2), (5, 3), (4, 4), (11, 10), (50, 50), (60, 17))
CONDITIONS = tuple(10.0**k for k in range(0, 17, 2))
KINDS = ("spread", "step", "duplicate", "zero column", "rank one")


def matrix(kind, shape, condition, dtype=float, seed=0):
    """(rows, columns) with singular values from 1 to 1/condition: evenly in log ("spread"), or
    all but one at 1 ("step"); or deficient.
    """
    rng = np.random.default_rng([seed, *shape, int(np.log10(condition))])
    rows, columns = shape
    u, v = (
        np.linalg.qr(rng.normal(size=(rows, columns)))[0],
        np.linalg.qr(rng.normal(size=(columns, columns)))[0],
    )
    s = (
        np.geomspace(1, 1 / condition, columns)
        if kind == "spread"
        else np.where(np.arange(columns) < columns - 1, 1, 1 / condition)
        if columns > 1
        else np.ones(1)
    )
    if kind == "rank one":
        s = np.where(np.arange(columns) == 0, 1.0, 0.0)
    a = (u * s) @ v.T
    if kind == "duplicate" and columns > 1:
        a[:, -1] = a[:, 0]
    if kind == "zero column":
        a[:, columns // 2] = 0
    return a.astype(dtype)


def _units(residual, a, x, y, extra=0.0):
    """A residual of normal equations in units of rounding errors, the worst signal."""
    norm = np.linalg.norm(a, 2)
    scale = EPS * (
        norm * (norm * np.linalg.norm(x, axis=0) + np.linalg.norm(y, axis=0))
        + extra * np.linalg.norm(x, axis=0)
    )
    return float(np.max(np.linalg.norm(residual, axis=0) / np.maximum(scale, np.finfo(float).tiny)))


def tikhonov(a, y, relative):
    """Units of A^T (y - A x) - alpha x, alpha = relative |A|^2."""
    svd = linear.decompose(a)
    alpha = relative * svd.s[0] ** 2
    x = linear.tikhonov(svd, svd.compress(y), alpha)
    return _units(a.T @ (y - a @ x) - alpha * x, a, x, y, alpha)


def truncated(a, y):
    """Units of V_r^T A^T (y - A x) at the numerical rank."""
    svd = linear.decompose(a)
    rank = svd.rank()
    x = linear.truncated(svd, svd.compress(y), rank)
    return _units(svd.vt[:rank] @ (a.T @ (y - a @ x)), a, x, y)


def nonnegative(a, y):
    """Units of the optimality conditions of converged non-negative least squares, or
    None where it refuses.
    """
    try:
        x = nnls.converged(a, y).x
    except NumericsError:
        return None
    g = a.T @ (a @ x - y)
    assert np.all(x >= 0)
    return _units(np.where(x > 0, np.abs(g), np.maximum(-g, 0)), a, x, y)


def demultiplexed(a, y, method):
    """Units of F^T (x - F b) for least squares by `spectral`, or None where all
    is refused as NaN.
    """
    b, _ = spectral.demultiplex(a, y.T, method, variance=1.0)
    if np.isnan(b).all():
        return None
    assert np.isfinite(b).all()
    return _units(a.T @ (y - a @ b.T), a, b.T, y)


def coded(a, y, relative, tol=1e-6):
    """(largest relative duality gap, largest excess) of the l1 solver at lambda = relative times
    the largest useful one.

    Excess: by how much the objective is above the better of no code and least squares, over it: no
    minimum is. Below 1e-8 of the largest lambda the slopes that certify a gap drown in rounding,
    and the gap, which comes with every code, says so.
    """
    most = 2 * np.abs(a.T @ y).max()
    lam = relative * (most if most > 0 else 1.0)
    code = sparse_code(a, y, lam, tol=tol, workers=1)
    assert np.isfinite(code.c).all()
    simple = np.linalg.pinv(a, rcond=1e-13) @ y
    known = np.minimum(
        (y**2).sum(axis=0), ((y - a @ simple) ** 2).sum(axis=0) + lam * np.abs(simple).sum(axis=0)
    )
    return float(code.gap.max()), float(np.max((code.objective - known) / np.maximum(known, 1e-20)))


def wiener(a, y, sigma):
    """The LMMSE estimate for a stationary field of points in a row, whose neighbours are alike."""
    points = np.arange(a.shape[1])
    covariance = 0.05 * 0.9 ** np.abs(points[:, None] - points)
    return lmmse.prepare(linear.decompose(a), np.full(a.shape[1], 0.4), covariance, sigma).adaptive(
        y
    )


def real_matrix():
    """A (2704, 1600) of an isolated lenslet of seed_spatial in double precision: condition 1e12."""
    camera = load_camera(SAMPLES / "seed_spatial.toml")
    request = dict(superpixels=(1, 1), coherent_ring=0, model="fresnel")
    return system_matrix(camera, accuracy=1e-8, dtype=np.float64, **request).A[0, 0]


def captures(a, count=2):
    """Name -> superpixels (pixel, lenslet) at the extremes of what a capture may hold."""
    rng = np.random.default_rng(5)
    clean = a @ rng.random((a.shape[1], count))
    noise = np.sqrt(np.mean(clean**2)) * rng.normal(size=clean.shape)
    hot = clean.copy()
    hot[len(hot) // 2] = 1e6 * clean.max()
    return {
        "60 dB": clean + 1e-3 * noise,
        "-40 dB": clean + 100 * noise,
        "all zero": 0 * clean,
        "one hot pixel": hot,
        "1e150": 1e150 * clean,
    }


def real_table():
    """Markdown: what answers by the real matrix violate of their equations, by capture."""
    a = real_matrix()
    rows = ["| capture | Tikhonov, 1e-12 | truncated |", "|---|---|---|"]
    for name, y in captures(a).items():
        rows.append(f"| {name} | {tikhonov(a, y, 1e-12):.2g} | {truncated(a, y):.2g} |")
    return "\n".join(rows)


def table(conditions=CONDITIONS, sizes=SIZES):
    """Markdown: the worst of all matrices of a condition, for each method; the numbers
    of `make extremes`.
    """
    rows = [
        (
            "| condition | Tikhonov, 1e-12 | truncated | non-negative | pseudo-inverse of F | "
            "weighted F | l1 gap, 1e-4 | l1 gap, 1e-10 |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    rng = np.random.default_rng(1)
    for condition in conditions:
        worst = [[] for _ in range(7)]
        for shape in sizes:
            for kind in KINDS[:2]:
                for dtype in (np.float32, np.float64):
                    a = matrix(kind, shape, condition, dtype).astype(float)
                    y = a @ rng.random((shape[1], 3)) + 1e-3 * rng.normal(size=(shape[0], 3))
                    found = (
                        tikhonov(a, y, 1e-12),
                        truncated(a, y),
                        nonnegative(a, y),
                        demultiplexed(a, y, "pinv"),
                        demultiplexed(a, y, "wls"),
                        coded(a, y, 1e-4)[0],
                        coded(a, y, 1e-10)[0],
                    )
                    for column, value in zip(worst, found):
                        column.append(value)
        cells = [
            "refused"
            if all(v is None for v in column)
            else f"{max(v for v in column if v is not None):.2g}"
            + (" or refused" if None in column else "")
            for column in worst
        ]
        rows.append(f"| {condition:.0e} | " + " | ".join(cells) + " |")
    return "\n".join(rows)
