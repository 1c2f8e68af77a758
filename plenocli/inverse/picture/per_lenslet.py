"""Methods of reconstruct that look at one lenslet at a time.

Each takes (camera, y (pixel, signal), sigma, truth or None, report) and returns x (point, signal);
camera is the Estimators that asks. The report learns the method's parameters.

Where a lenslet takes long, what is the same for all is worked out first, and the lenslets are
solved in batches, by a function of (camera, batch, ...) that other processes can run.
"""

import numpy as np

from plenocli.base.progress import note

SPLIT = ("nnls", "dictionary")
"""Methods whose lenslets are solved in batches."""
BATCH = {"nnls": 64, "nnls converged": 4, "dictionary": 128}
"""Lenslets of a batch: some seconds of work. The same however many work, as the last
digits depend on it.
"""
HINDSIGHT = "oracle: least error against the truth, which no camera has"
LOUDER_POWER = 1.75
"""Lambda grows with the noise to this power, by validation; 2 would be the most probable code of
coefficients with one Laplacian density.
"""
TOO_LOUD = 50
"""Times the noise that a dictionary was learnt for, from which on it falls behind lmmse."""


def block_mean(camera, y, sigma, truth, report):
    """One value a lenslet and band."""
    system = camera.system
    return np.repeat(system.levels(y.T).T, int(np.prod(system.object_shape)), axis=0)


def tikhonov(camera, y, sigma, truth, report):
    """Weight given, by the discrepancy principle, or with hindsight."""
    from plenocli.inverse.picture.solvers import least_squares as linear

    svd, alpha, rule = camera.svd, camera.settings.alpha, "given"
    z = svd.compress(y)
    if alpha is None:
        alpha, rule = (
            (linear.discrepancy_alpha(svd, z, sigma), "discrepancy")
            if truth is None
            else (linear.oracle_alpha(svd, z, truth), HINDSIGHT)
        )
    report |= {"alpha": float(alpha), "rule": rule}
    return linear.tikhonov(svd, z, alpha)


def tsvd(camera, y, sigma, truth, report):
    """Rank given, by the least estimated error, or with hindsight."""
    from plenocli.inverse.picture.solvers import least_squares as linear

    svd, rank, rule = camera.svd, camera.settings.rank, "given"
    z = svd.compress(y)
    if rank is None:
        rank, rule = (
            (linear.best_rank(svd, z, sigma), "least estimated error")
            if truth is None
            else (linear.oracle_rank(svd, z, truth), HINDSIGHT)
        )
    rank = min(rank, svd.rank())
    report |= {"rank": int(rank), "rule": rule}
    return linear.truncated(svd, z, rank)


def nnls(camera, y, sigma, truth, report):
    """Converged, or stopped after settings.nnls_iterations."""
    svd, steps = camera.svd, camera.settings.nnls_iterations
    lenslets, points = y.shape[1], svd.vt.shape[1]
    if not steps and lenslets * points > 50_000:
        note(
            f"converged non-negative least squares of {lenslets} lenslets takes about "
            f"{2 * lenslets * (points / 1600) ** 2.5 / 60:.0f} minutes of CPU; "
            "--nnls-iterations 300 stops early"
        )
    found = camera.in_batches(
        nnls_batch, svd.compress(y), BATCH["nnls" if steps else "nnls converged"]
    )
    report |= {
        "kkt_violation": max(kkt for _, kkt in found),
        "rule": f"stopped after {steps} steps of accelerated projected gradient from 0"
        if steps
        else "converged, optimality conditions checked",
    }
    return np.concatenate([x for x, _ in found], axis=1)


def nnls_batch(camera, z):
    """(x (point, signal), worst violation of the optimality conditions) of compressed signals z."""
    from plenocli.inverse.picture.solvers import nnls

    matrix, steps = camera.svd.s[:, None] * camera.svd.vt, camera.settings.nnls_iterations
    found = (
        nnls.projected_gradient(matrix, z, steps, norm=camera.svd.s[0])
        if steps
        else nnls.converged(matrix, z)
    )
    return found.x, float(found.kkt.max())


def dictionary(camera, y, sigma, truth, report):
    """The mean over the mirror images of a learnt dictionary."""
    learnt, svd, asked = camera.learnt, camera.svd, camera.settings.lam
    scale = float(svd.s[0])
    louder = max(1.0, sigma / scale / learnt.sigma) if learnt.sigma > 0 else 1.0
    lam = asked if asked is not None else learnt.lam * louder**LOUDER_POWER
    if louder > TOO_LOUD:
        note(
            f"the dictionary was learnt for {louder:.3g} times less noise than this capture has: "
            "--method lmmse is as good or better here"
        )
    kept = min(svd.rank(), len(svd.s) if learnt.directions is None else learnt.directions)
    z = svd.compress(y)[:kept] / scale
    found = camera.in_batches(dictionary_batch, z, BATCH["dictionary"], lam)
    nonzeros = sum(n * part.shape[1] for part, _, n in found) / z.shape[1]
    rule = (
        "given"
        if asked is not None
        else "lambda as learnt"
        if louder < 1.01
        else f"lambda as learnt, times {louder**LOUDER_POWER:.3g} for {louder:.3g} times the noise"
    )
    report |= {
        "lambda": lam,
        "rule": rule,
        "average": "over the mirror images of the dictionary",
        "worst_gap": max(gap for _, gap, _ in found),
        "nonzeros": nonzeros,
    }
    return np.concatenate([x for x, _, _ in found], axis=1)


def dictionary_batch(camera, z, lam):
    """(x (point, signal), worst gap, mean non-zeros) of compressed signals z (direction,
    signal), relative to the largest singular value.
    """
    from plenocli.inverse.sparse.dictionary import averaged

    svd, kept = camera.svd, len(z)
    seen = (svd.s[:kept, None] / float(svd.s[0])) * svd.vt[:kept]
    return averaged(
        seen,
        camera.learnt.atoms,
        z,
        lam,
        camera.system.object_shape,
        synthesis=camera.learnt.synthesis,
        workers=camera.threads,
    )


METHODS = {
    "block-mean": block_mean,
    "tikhonov": tikhonov,
    "tsvd": tsvd,
    "nnls": nnls,
    "dictionary": dictionary,
}
