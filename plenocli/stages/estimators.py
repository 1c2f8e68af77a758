"""The methods of reconstruct: each is set up once and then serves every capture made with the same camera."""

from functools import cached_property

import numpy as np

from plenocli.errors import InputError
from plenocli.stages.progress import note
from plenocli.stages.training import read_training

PATCHES_A_POINT = 6
"""Training patches for the LMMSE covariance, for each object point."""


class Estimators:
    """Solvers for one system matrix (stages.systems.System) under the options of the command (stages.reconstruct.Settings)."""

    def __init__(self, system, settings):
        self.system, self.settings, self._cache = system, settings, {}
        self.coupled = len(system.offsets) > 1

    @cached_property
    def svd(self):
        from plenocli.solvers.linear import decompose

        return decompose(self.system.own)

    def solve(self, data, truth=None):
        """(x, sigma or None, report) of Superpixels: x (lenslet_row, lenslet_column, point), report a dict with "method".

        truth (like x): chooses the weight of tikhonov or tsvd with hindsight.
        """
        from plenocli.solvers.overlap import without_neighbours

        method, reason = self._method()
        report = {"method": method, "reason": reason, "overlap": self.settings.overlap}
        sigma = self._noise(data, report) if method in ("tikhonov", "tsvd", "lmmse", "dictionary") else None
        stacked = data.y.reshape(-1, data.y.shape[2]).T
        if method == "lmmse" and self.settings.overlap == 3:
            x, spread = self._joint(sigma, data.scene).apply(data.y)
            return x, spread, report
        if method == "lmmse":
            estimator = self._lmmse(sigma, data.scene)
            x = self._around(estimator.apply, data.y)
            return x, np.broadcast_to(estimator.sigma, x.shape), report
        hidden = None if truth is None else truth.reshape(len(stacked.T), -1).T
        solver = {"block-mean": self._block_mean, "tikhonov": self._tikhonov, "tsvd": self._tsvd, "nnls": self._nnls, "dictionary": self._dictionary}[method]
        solve = solver(stacked, sigma, hidden, report)
        if method == "tikhonov" and self.settings.overlap == 3 and self.coupled:
            return self._joint_tikhonov(data.y, without_neighbours(solve, self.system.blocks, self.system.offsets, data.y), report), None, report
        return self._around(solve, data.y), None, report

    def _method(self):
        asked = self.settings.method
        if asked != "auto":
            return asked, "asked for"
        if self.settings.dictionary is not None:
            return "dictionary", "a dictionary was given"
        return "lmmse", "the best of the linear methods, with its own error estimate"

    def _around(self, solve, y):
        """Per lenslet; with --overlap 3 the neighbours' light is taken away by repetition."""
        from plenocli.solvers.overlap import without_neighbours

        if self.settings.overlap == 3 and not self.coupled:
            note("--overlap 3: the pif holds own superpixels only, so there is no neighbours' light to take away (simulate-pif --superpixels 3x3)")
        sweeps = 3 if self.settings.overlap == 3 else 0
        return without_neighbours(solve, self.system.blocks, self.system.offsets, y, sweeps=sweeps)

    def _noise(self, data, report):
        """Standard deviation of the noise in y: as given, as the capture says, or estimated, and which."""
        from plenocli.solvers.linear import estimate_noise

        if self.settings.noise_sigma is not None:
            sigma, source = self.settings.noise_sigma, "given"
        elif data.sigma:
            sigma, source = data.sigma, "from the capture"
        else:
            stacked = data.y.reshape(-1, data.y.shape[2]).T
            sigma, source = estimate_noise(self.svd, stacked), "estimated from what the system matrix cannot produce"
            sigma = max(sigma, 1e-12 * float(np.abs(stacked).max(initial=0)), np.finfo(float).tiny)
            note(f"the capture does not say its noise: sigma = {sigma:.3g}, {source}")
        report |= {"noise_sigma": float(sigma), "noise_source": source}
        return float(sigma)

    def _block_mean(self, stacked, sigma, truth, report):
        uniform = self.system.own.sum(axis=1)
        points = self.system.own.shape[1]
        return lambda y: np.repeat((uniform @ y / (uniform @ uniform))[None], points, axis=0)

    def _tikhonov(self, stacked, sigma, truth, report):
        from plenocli.solvers import linear

        z = self.svd.compress(stacked)
        if self.settings.alpha is not None:
            alpha, rule = self.settings.alpha, "given"
        elif truth is not None:
            alpha, rule = linear.oracle_alpha(self.svd, z, truth), "oracle: least error against the truth, which no camera has"
        else:
            alpha, rule = linear.discrepancy_alpha(self.svd, z, sigma), "discrepancy"
        report |= {"alpha": float(alpha), "rule": rule}
        return lambda y: linear.tikhonov(self.svd, self.svd.compress(y), alpha)

    def _tsvd(self, stacked, sigma, truth, report):
        from plenocli.solvers import linear

        z = self.svd.compress(stacked)
        if self.settings.rank is not None:
            rank, rule = min(self.settings.rank, self.svd.rank()), "given"
        elif truth is not None:
            rank, rule = linear.oracle_rank(self.svd, z, truth), "oracle: least error against the truth, which no camera has"
        else:
            rank, rule = linear.discrepancy_rank(self.svd, z, sigma), "discrepancy"
        report |= {"rank": int(rank), "rule": rule}
        return lambda y: linear.truncated(self.svd, self.svd.compress(y), rank)

    def _nnls(self, stacked, sigma, truth, report):
        from plenocli.solvers import nnls

        matrix = self.svd.s[:, None] * self.svd.vt
        steps = self.settings.nnls_iterations

        def solve(y):
            z = self.svd.compress(y)
            found = nnls.projected_gradient(matrix, z, steps) if steps else nnls.converged(matrix, z, workers=self.settings.workers)
            report["kkt_violation"] = float(found.kkt.max())
            return found.x

        if not steps and stacked.shape[1] * matrix.shape[1] > 50_000:
            note(f"converged non-negative least squares of {stacked.shape[1]} lenslets takes about {2 * stacked.shape[1] * (matrix.shape[1] / 1600) ** 2.5 / 60:.0f} minutes of CPU; "
                 "--nnls-iterations 300 stops early")
        report["rule"] = f"stopped after {steps} steps of accelerated projected gradient from 0" if steps else "converged, optimality conditions checked"
        return solve

    def _dictionary(self, stacked, sigma, truth, report):
        from plenocli.artefacts import file_digest, read_artefact
        from plenocli.solvers.l1 import sparse_code

        path = self.settings.dictionary
        artefact = read_artefact(path, "dictionary", mem_limit=self.settings.mem_limit)
        atoms, attrs = np.asarray(artefact.data["dictionary/atoms"], float), artefact.attrs["dictionary"]
        if len(atoms) != self.system.own.shape[1]:
            raise InputError(f"has atoms of {len(atoms)} points, the system matrix {self.system.own.shape[1]}", path, "learn it with this pif")
        if artefact.provenance.inputs.get("pif", {}).get("sha256") != file_digest(self.system.path):
            note(f"the dictionary was learnt for another system matrix than {self.system.path.name}")
        lam = self.settings.lam if self.settings.lam is not None else float(attrs["lambda"])
        scale = float(self.svd.s[0])
        kept = self.svd.rank()
        seen = (self.svd.s[:kept, None] / scale) * self.svd.vt[:kept] @ atoms
        report |= {"lambda": lam, "rule": "as learnt" if self.settings.lam is None else "given"}

        def solve(y):
            code = sparse_code(seen, self.svd.compress(y)[:kept] / scale, lam, free=[0])
            report.update(worst_gap=float(code.gap.max()), nonzeros=float(np.count_nonzero(code.c[1:], axis=0).mean()))
            return atoms @ code.c

        return solve

    def _training(self, scene):
        key = ("pictures", scene)
        if key not in self._cache:
            self._cache[key] = [p for _, p in read_training(self.settings.training, self.system.object_shape, not_scene=scene)]
        return self._cache[key]

    def _lmmse(self, sigma, scene):
        from plenocli.solvers import lmmse, natural

        pictures = self._training(scene)
        if ("statistics", scene) not in self._cache:
            count = PATCHES_A_POINT * self.system.own.shape[1]
            patches = natural.draw_patches(pictures, self.system.object_shape, count, np.random.default_rng([self.settings.seed, 1]))
            self._cache["statistics", scene] = natural.mean_covariance(patches)
        if ("lmmse", sigma, scene) not in self._cache:
            self._cache["lmmse", sigma, scene] = lmmse.prepare(self.svd, *self._cache["statistics", scene], sigma)
        return self._cache["lmmse", sigma, scene]

    def _joint(self, sigma, scene):
        from plenocli.solvers import natural, overlap

        system, key = self.system, ("joint", sigma, scene)
        if key not in self._cache:
            statistics = natural.autocovariance(self._training(scene), overlap.needed_reach(system.object_shape, system.offsets))
            self._cache[key] = overlap.prepare_joint(self.svd, system.blocks, system.offsets, system.object_shape, *statistics, sigma)
        return self._cache[key]

    def _joint_tikhonov(self, y, start, report):
        from plenocli.solvers.overlap import joint_tikhonov

        x, residual = joint_tikhonov(self.system.blocks, self.system.offsets, y, report["alpha"], start=start, iterations=300)
        report["normal_residual"] = residual
        return x
