"""Methods of reconstruct that look at one lenslet at a time. Each takes (camera, y (pixel, signal), sigma, truth or None, report) and
returns x (point, signal); camera is the Estimators that asks. The report learns the method's parameters."""

import numpy as np

from plenocli.errors import InputError
from plenocli.stages.progress import note

HINDSIGHT = "oracle: least error against the truth, which no camera has"


def block_mean(camera, y, sigma, truth, report):
    """One value a lenslet and band."""
    system = camera.system
    return np.repeat(system.levels(y.T).T, int(np.prod(system.object_shape)), axis=0)


def tikhonov(camera, y, sigma, truth, report):
    """Weight given, by the discrepancy principle, or with hindsight."""
    from plenocli.solvers import linear

    svd, alpha, rule = camera.svd, camera.settings.alpha, "given"
    z = svd.compress(y)
    if alpha is None:
        alpha, rule = (linear.discrepancy_alpha(svd, z, sigma), "discrepancy") if truth is None else (linear.oracle_alpha(svd, z, truth), HINDSIGHT)
    report |= {"alpha": float(alpha), "rule": rule}
    return linear.tikhonov(svd, z, alpha)


def tsvd(camera, y, sigma, truth, report):
    """Rank given, by the least estimated error, or with hindsight."""
    from plenocli.solvers import linear

    svd, rank, rule = camera.svd, camera.settings.rank, "given"
    z = svd.compress(y)
    if rank is None:
        rank, rule = (linear.best_rank(svd, z, sigma), "least estimated error") if truth is None else (linear.oracle_rank(svd, z, truth), HINDSIGHT)
    rank = min(rank, svd.rank())
    report |= {"rank": int(rank), "rule": rule}
    return linear.truncated(svd, z, rank)


def nnls(camera, y, sigma, truth, report):
    """Converged, or stopped after settings.nnls_iterations."""
    from plenocli.solvers import nnls

    svd, steps = camera.svd, camera.settings.nnls_iterations
    matrix, z = svd.s[:, None] * svd.vt, svd.compress(y)
    if not steps and z.shape[1] * matrix.shape[1] > 50_000:
        note(f"converged non-negative least squares of {z.shape[1]} lenslets takes about {2 * z.shape[1] * (matrix.shape[1] / 1600) ** 2.5 / 60:.0f} minutes of CPU; "
             "--nnls-iterations 300 stops early")
    found = nnls.projected_gradient(matrix, z, steps) if steps else nnls.converged(matrix, z, workers=camera.settings.workers)
    report |= {"kkt_violation": float(found.kkt.max()),
               "rule": f"stopped after {steps} steps of accelerated projected gradient from 0" if steps else "converged, optimality conditions checked"}
    return found.x


def dictionary(camera, y, sigma, truth, report):
    """The mean over the mirror images of a learnt dictionary."""
    from plenocli.solvers.dictionary import averaged

    atoms, paint, attrs = camera.learnt
    svd, asked = camera.svd, camera.settings.lam
    scale = float(svd.s[0])
    learnt = float(attrs["parameters"]["sigma"])
    louder = max(1.0, sigma / scale / learnt) if learnt > 0 else 1.0
    lam = asked if asked is not None else float(attrs["lambda"]) * louder
    kept = min(svd.rank(), attrs["parameters"].get("directions", len(svd.s)))
    seen = (svd.s[:kept, None] / scale) * svd.vt[:kept]
    x, gap, nonzeros = averaged(seen, atoms, svd.compress(y)[:kept] / scale, lam, camera.system.object_shape, synthesis=paint)
    rule = "given" if asked is not None else "lambda as learnt" if louder < 1.01 else f"lambda as learnt, times {louder:.3g} for more noise"
    report |= {"lambda": lam, "rule": rule, "average": "over the mirror images of the dictionary", "worst_gap": gap, "nonzeros": nonzeros}
    return x


def read_dictionary(path, system, mem_limit=None):
    """(atoms that code, atoms that paint, attributes) of a dictionary for `system`; a note where it was learnt for another matrix."""
    from plenocli.artefacts import file_digest, read_artefact

    artefact = read_artefact(path, "dictionary", mem_limit=mem_limit)
    atoms = np.asarray(artefact.data["dictionary/atoms"], float)
    if len(atoms) != system.own.shape[1]:
        several = f" in {len(system.bands)} bands" if len(system.bands) > 1 else ""
        raise InputError(f"has atoms of {len(atoms)} points, the system matrix {system.own.shape[1]}{several}", path,
                         "use another method: dictionaries have one band" if several else "learn it with this pif")
    if artefact.provenance.inputs.get("pif", {}).get("sha256") != file_digest(system.path):
        note(f"the dictionary was learnt for another system matrix than {system.path.name}")
    return atoms, np.asarray(artefact.data.get("dictionary/synthesis", atoms), float), artefact.attrs["dictionary"]


METHODS = {"block-mean": block_mean, "tikhonov": tikhonov, "tsvd": tsvd, "nnls": nnls, "dictionary": dictionary}
