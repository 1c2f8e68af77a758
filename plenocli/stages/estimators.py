"""The methods of reconstruct: each is set up once and then serves every capture made with the same camera."""

from functools import cached_property

import numpy as np

from plenocli.errors import InputError, NumericsError
from plenocli.stages.progress import note
from plenocli.operators import to_blocks, to_plane
from plenocli.solvers.overlap import by_lenslet
from plenocli.stages.seeds import stream
from plenocli.stages.training import at_scales, read_training

PATCHES_A_POINT = 6
"""Training patches for the LMMSE covariance, for each object point."""


NOISY = ("tikhonov", "tsvd", "lmmse", "dictionary")
WHOLE = ("pnp", "tv")
"""Methods that reconstruct all lenslets together."""
TRIALS, TRIAL_SIDE = 5, 3
"""Pieces of training pictures, of so many lenslets a side, on which `auto` tries its candidates."""
MARGIN = 0.05
"""dB by which a method must be better in the trial to be taken instead of lmmse."""
SLOW = 2000
"""Lenslets from which on the time of whole-picture methods is told beforehand."""
CONTRAST = 0.1
"""What a point of a photograph differs from its lenslet's brightness, standard deviation: the measure of what noise hides."""
MISFIT = 1.5
"""Estimated noise over the capture's own from which on the estimate is believed."""


class Estimators:
    """Solvers for one system matrix (stages.systems.System) under the options of the command (stages.reconstruct.Settings)."""

    def __init__(self, system, settings):
        self.system, self.settings, self._cache = system, settings, {}
        self.coupled = len(system.offsets) > 1
        self.overlap = settings.overlap or (3 if self.coupled else 1)

    @cached_property
    def svd(self):
        from plenocli.solvers.linear import decompose

        return decompose(self.system.own)

    def solve(self, data, truth=None):
        """(x, sigma or None, report) of Superpixels: x (lenslet_row, lenslet_column, point), report a dict with "method".

        truth (like x): chooses the weight of tikhonov or tsvd with hindsight.
        """
        report = {"method": self.settings.method, "reason": "asked for"}
        if self.settings.method == "auto":
            report |= self._choose(data)
        return *self._run(report["method"], data, truth, report), report

    def seen(self, sigma):
        """(map, report): what of an object the own superpixel tells apart at noise `sigma`, points (row, column) from 0 (in the null
        space) to 1; its mean, the directions that stand above the noise, and whether an object and itself turned look alike."""
        from plenocli.optics.diagnose import SYMMETRY_WARNING, symmetry_defect
        from plenocli.solvers.linear import resolution

        share = resolution(self.svd, sigma, CONTRAST)
        report = {"share": float(share.mean()), "directions": int(np.count_nonzero(self.svd.s * CONTRAST > sigma)), "points": len(share)}
        if symmetry_defect(self.system.own) < SYMMETRY_WARNING:
            report["symmetric"] = True
            note("half of the object cannot be seen: object points opposite each other about the lenslet's axis give the same superpixel, and only their sum is "
                 "measured (move the sensor out of the pupil's conjugate plane)")
        return share.reshape(self.system.object_shape), report

    def _run(self, method, data, truth, report):
        """(x, sigma or None) by one method; its parameters go to the report."""
        report["overlap"] = self.overlap
        if self.overlap == 3 and not self.coupled and method != "lmmse":
            note("--overlap 3: the pif holds own superpixels only, so there is no neighbours' light to take away (simulate-pif --superpixels 3x3)")
        if method == "lmmse" and self.overlap == 3:
            return self._jointly(data, report)
        hidden = None if truth is None else truth.reshape(-1, truth.shape[2]).T
        if not self._takes_neighbours(method):
            return self._whole(method, data, data.y, report) if method in WHOLE else self._by_lenslet(method, data, data.y, hidden, report)
        x, spread = self._jointly(data, {})
        report["neighbours"] = "their light is taken away as LMMSE over 3x3 lenslets sees it"
        report["border"] = "lenslets that lack neighbours are those of LMMSE over 3x3 lenslets: light from beyond the array cannot be taken away"
        if min(data.y.shape[:2]) <= 2:
            return x, spread
        y, inner = self._own_light(data.y, x), (slice(1, -1), slice(1, -1))
        if method in WHOLE:
            return self._whole(method, data, y, report, (x, spread))
        x[inner], _ = self._by_lenslet(method, data, y[inner], None if truth is None else truth[inner].reshape(-1, truth.shape[2]).T, report)
        return x, None

    def _choose(self, data):
        """{"method", "reason", "trial_db"} for this noise: the best of the candidates on pieces of photographs, seen by this camera.

        What is compared is measured, not promised: TRIALS pieces of training pictures, of about the capture's contrast, are
        captured by the own block with the noise of this capture, relative to the signal, and reconstructed by each candidate. lmmse has seen these pictures in
        its covariance, so that a method that wins wins in earnest.
        """
        candidates = ["lmmse", "pnp", *(["dictionary"] if self.settings.dictionary is not None else [])]
        sigma = self._joint_noise(data, {}) if self.coupled else self._noise(data, data.y, {})
        loudness = max(np.sqrt(np.mean(np.square(data.y))), 1e-3 * sigma)  # an empty capture is all noise
        relative = float(f"{sigma / loudness:.1e}")
        contrast = self._contrast(data, sigma)
        key = ("trial", relative, contrast, data.scene)
        if key not in self._cache:
            self._cache[key] = self._trial(candidates, relative, contrast, data.scene)
        quality = self._cache[key]
        if not quality:
            return {"method": "lmmse", "reason": "the training pictures are too small for a trial of others"}
        best = max(quality, key=quality.get)
        best = best if quality[best] > quality["lmmse"] + MARGIN else "lmmse"
        told = ", ".join(f"{m} {q:.1f} dB" for m, q in quality.items())
        if best in WHOLE and data.y.shape[0] * data.y.shape[1] > SLOW:
            note(f"{best} of {data.y.shape[0] * data.y.shape[1]} lenslets takes about {data.y.shape[0] * data.y.shape[1] * self.system.own.shape[1] * 1e-4 / 60:.0f} minutes of CPU; --method lmmse takes seconds")
        return {"method": best, "reason": f"best on pieces of training photographs at this noise ({told})", "trial_db": quality}

    def _contrast(self, data, sigma):
        """Variance within a lenslet over its squared brightness, as LMMSE sees this capture; in powers of two, that captures share trials."""
        y = data.y - self._stray(data.y) if self.coupled else data.y
        estimator = self._lmmse(sigma, data.scene)
        bright = max(float(np.mean(y @ estimator.uniform)) / float(estimator.uniform @ estimator.uniform), 1e-6)
        scale = estimator.common_scale(y.reshape(-1, y.shape[2]).T)
        return 2.0 ** round(np.log2(scale * estimator.variance.mean() / bright**2))

    def _trial(self, candidates, relative, contrast, scene):
        """Mean PSNR (dB) of each candidate over pieces of about this contrast, {} where no picture is large enough."""
        from dataclasses import replace

        from plenocli.solvers.natural import draw_patches
        from plenocli.stages.superpixels import Superpixels

        shape = self.system.object_shape
        side = tuple(TRIAL_SIDE * n for n in shape)
        large = [p for p in self._training(scene) if p.shape[0] >= side[0] and p.shape[1] >= side[1]]
        if not large:
            return {}
        rng = stream(self.settings.seed, "trial")
        pieces = draw_patches(large, side, 16 * TRIALS, rng).T.reshape(-1, *side)
        within = [to_blocks(p, shape).var(axis=2).mean() / max(p.mean() ** 2, 1e-12) for p in pieces]
        alike = np.argsort(np.abs(np.log(np.maximum(within, 1e-12) / contrast)), kind="stable")[:TRIALS]
        truth = to_blocks(np.concatenate([pieces[k] for k in alike], axis=1), shape)
        y = truth @ self.system.own.T
        sigma = relative * float(np.sqrt(np.mean(y**2)))
        y += sigma * rng.standard_normal(y.shape)
        alone = Estimators(replace(self.system, blocks=self.system.own[None], offsets=np.zeros((1, 2), int)), replace(self.settings, noise_sigma=sigma, overlap=1))
        alone.svd, alone._cache = self.svd, self._cache
        data = Superpixels(y, sigma, scene)
        quality = {}
        for method in candidates:
            error = np.square(alone._run(method, data, None, {})[0] - truth).reshape(TRIAL_SIDE, TRIALS, -1).mean(axis=(0, 2))
            quality[method] = float(np.mean(-10 * np.log10(np.maximum(error, 1e-12))))
        return quality

    def _whole(self, method, data, y, report, known=None):
        """(x, sigma) of a method that sees the whole picture; sigma is that of LMMSE, from which it starts: an upper estimate.

        y: own light, like data.y.  known: (x, sigma) of the estimate that took the neighbours' light away; the border keeps it.
        """
        from plenocli.solvers import wholesensor
        from plenocli.solvers.denoise import block_matching

        inner, shape, held = (slice(None), slice(None)), self.system.object_shape, None
        if known is not None:
            edge = np.ones(y.shape[:2], bool)
            inner = (slice(1, -1), slice(1, -1))
            edge[inner], held = False, (edge, known[0].copy())
        sigma = self._noise(data, y[inner], report)
        x, spread = known or np.empty((2, *y.shape[:2], self.svd.vt.shape[1]))
        x[inner], spread[inner] = self._adaptive(sigma, data.scene, y[inner])
        error = float(np.sqrt(np.mean(np.square(spread[inner]))))
        report["start"] = f"lmmse, which expects an error of {error:.3g}"
        term = wholesensor.DataTerm(self.svd, shape, y, sigma, 2 * error, held)
        if method == "tv":
            picture = wholesensor.total_variation(term, to_plane(x, shape), error)
            report["rule"] = "isotropic total variation, weight by the error that lmmse expects"
        else:
            taus = wholesensor.schedule(error)
            picture = wholesensor.plug_and_play(term, to_plane(x, shape), block_matching, taus)
            report["rule"] = f"{len(taus)} rounds of block matching, from {taus[0]:.3g} to {taus[-1]:.3g}"
        return to_blocks(picture, shape), spread

    def _adaptive(self, sigma, scene, y):
        """(x, sigma) of LMMSE per lenslet, like y (lenslet_row, lenslet_column, pixel)."""
        rows, columns = y.shape[:2]
        x, spread, _ = self._lmmse(sigma, scene).adaptive(y.reshape(rows * columns, -1).T)
        return x.T.reshape(rows, columns, -1), spread.T.reshape(rows, columns, -1)

    def _by_lenslet(self, method, data, y, truth, report):
        """(x, sigma or None) of superpixels y (lenslet_row, lenslet_column, pixel), each by itself."""
        sigma = self._noise(data, y, report) if method in NOISY else None
        if method == "lmmse":
            return self._adaptive(sigma, data.scene, y)
        return by_lenslet(self._solver(method, y, sigma, truth, report), y), None

    def _jointly(self, data, report):
        """(x, sigma) of LMMSE over 3x3 lenslets, the covariance scaled to this picture's contrast; once more with the noise that
        is left over, where that is MISFIT times larger."""
        sigma = self._joint_noise(data, report)
        x, spread = self._scaled(data, sigma, report)
        left = self._left_over(data.y, x)
        if self.coupled and self.settings.noise_sigma is None and left > MISFIT * sigma:
            note(f"the capture holds {left / sigma:.3g} times more than its noise that the system matrix cannot produce: sigma = {left:.3g} is used")
            report |= {"noise_sigma": left, "noise_source": "what the estimate leaves over"}
            x, spread = self._scaled(data, left, report)
        return x, spread

    def _scaled(self, data, sigma, report):
        """(x, sigma) of the joint estimate with scale x covariance, one scale a picture; steps of sqrt(2), so that captures of
        one kind share what is worked out."""
        y = data.y - self._stray(data.y) if self.coupled else data.y
        y = y[1:-1, 1:-1] if min(y.shape[:2]) > 2 else y
        scale = self._lmmse(sigma, data.scene).common_scale(y.reshape(-1, y.shape[2]).T)
        # never above 1: light that the matrix does not produce passes for contrast, and would be amplified
        scale = min(1.0, 2.0 ** (round(2 * np.log2(scale)) / 2))
        report["scale"] = scale
        x, spread = self._joint(sigma / np.sqrt(scale), data.scene).apply(data.y)
        return x, np.sqrt(scale) * spread

    def _left_over(self, y, x):
        """Root mean square of y - A x over the lenslets that have all their neighbours (all, where none has)."""
        from plenocli.operators import BlockToeplitz

        rest = y - BlockToeplitz(self.system.blocks, self.system.offsets, y.shape[:2]).forward(x)
        inner = rest[1:-1, 1:-1]
        return float(np.sqrt(np.mean((inner if inner.size else rest) ** 2)))

    def _own_light(self, y, x):
        """The superpixels y without the light that the objects x under their neighbours send.

        An estimate per lenslet cannot tell that light from its own and amplifies it; taking it away by repeated estimates
        diverges where the matrix is ill-conditioned, so that x comes from the joint estimate.
        """
        from plenocli.operators import BlockToeplitz

        return y - BlockToeplitz(self.system.blocks, self.system.offsets, y.shape[:2]).neighbours_only().forward(x)

    def _solver(self, method, y, sigma, truth, report):
        setup = {"block-mean": self._block_mean, "tikhonov": self._tikhonov, "tsvd": self._tsvd, "nnls": self._nnls, "dictionary": self._dictionary}[method]
        return setup(y.reshape(-1, y.shape[2]).T, sigma, truth, report)

    def _noise(self, data, y, report):
        """Standard deviation of what in y is not A x: given, the capture's own, or estimated; the report says which.

        The estimate also wins over the capture's figure where it is MISFIT times larger: then y holds more than A x and the
        sensor's noise (neighbours' light, another matrix), which would be amplified if it were trusted as signal.
        """
        if self.settings.noise_sigma is not None:
            sigma, source = self.settings.noise_sigma, "given"
        else:
            sigma, source = self._estimated(data, y.reshape(-1, y.shape[2]).T)
        report |= {"noise_sigma": float(sigma), "noise_source": source}
        return float(sigma)

    def _joint_noise(self, data, report):
        """The noise for the joint estimate, which models the neighbours' light: the capture's own, if it says so."""
        if not self.coupled or self.settings.noise_sigma is not None or data.sigma is None:
            return self._noise(data, data.y - self._stray(data.y) if self.coupled else data.y, report)
        sigma = max(data.sigma, _floor(data.y))
        report |= {"noise_sigma": sigma, "noise_source": "from the capture"}
        return sigma

    def _takes_neighbours(self, method=None):
        return self.coupled and self.overlap == 3 and (method or self.settings.method) != "block-mean"

    def _stray(self, y):
        """The neighbours' light, from the block means: enough to estimate the noise."""
        from plenocli.operators import BlockToeplitz

        op = BlockToeplitz(self.system.blocks, self.system.offsets, y.shape[:2])
        uniform = self.system.own.sum(axis=1)
        level = y @ uniform / (uniform @ uniform)
        return op.neighbours_only().forward(np.broadcast_to(level[:, :, None], op.domain.shape))

    def _estimated(self, data, stacked):
        from plenocli.solvers.linear import estimate_noise

        floor = _floor(stacked)
        try:
            sigma = max(estimate_noise(self.svd, stacked), floor)
        except NumericsError:
            if not data.sigma:
                raise
            return data.sigma, "from the capture"
        if data.sigma is None:
            note(f"the capture does not say its noise: sigma = {sigma:.3g}, estimated from what the system matrix cannot produce")
        elif sigma <= MISFIT * max(data.sigma, floor):
            return max(data.sigma, floor), "from the capture"
        else:
            hint = "" if self._takes_neighbours() else ". If it is the neighbours' light, use a pif of --superpixels 3x3 with --overlap 3"
            note(f"the capture holds {sigma / max(data.sigma, floor):.3g} times more than its noise that the system matrix cannot produce: sigma = {sigma:.3g} is used{hint}")
        return sigma, "estimated from what the system matrix cannot produce"

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
            rank, rule = linear.best_rank(self.svd, z, sigma), "least estimated error"
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

    @cached_property
    def _learnt(self):
        """(atoms that code, atoms that paint, attributes) of the dictionary; a note where it was learnt for another matrix."""
        from plenocli.artefacts import file_digest, read_artefact

        path = self.settings.dictionary
        artefact = read_artefact(path, "dictionary", mem_limit=self.settings.mem_limit)
        atoms = np.asarray(artefact.data["dictionary/atoms"], float)
        if len(atoms) != self.system.own.shape[1]:
            raise InputError(f"has atoms of {len(atoms)} points, the system matrix {self.system.own.shape[1]}", path, "learn it with this pif")
        if artefact.provenance.inputs.get("pif", {}).get("sha256") != file_digest(self.system.path):
            note(f"the dictionary was learnt for another system matrix than {self.system.path.name}")
        return atoms, np.asarray(artefact.data.get("dictionary/synthesis", atoms), float), artefact.attrs["dictionary"]

    def _dictionary(self, stacked, sigma, truth, report):
        from plenocli.solvers.dictionary import averaged

        atoms, paint, attrs = self._learnt
        scale = float(self.svd.s[0])
        learnt = float(attrs["parameters"]["sigma"])
        louder = max(1.0, sigma / scale / learnt) if learnt > 0 else 1.0
        lam = self.settings.lam if self.settings.lam is not None else float(attrs["lambda"]) * louder
        kept = min(self.svd.rank(), attrs["parameters"].get("directions", len(self.svd.s)))
        seen = (self.svd.s[:kept, None] / scale) * self.svd.vt[:kept]
        report |= {"lambda": lam, "rule": "given" if self.settings.lam is not None else "lambda as learnt" if louder < 1.01 else f"lambda as learnt, times {louder:.3g} for more noise",
                   "average": "over the mirror images of the dictionary"}

        def solve(y):
            x, gap, nonzeros = averaged(seen, atoms, self.svd.compress(y)[:kept] / scale, lam, self.system.object_shape, synthesis=paint)
            report.update(worst_gap=gap, nonzeros=nonzeros)
            return x

        return solve

    def _training(self, scene):
        key = ("pictures", scene)
        if key not in self._cache:
            self._cache[key] = [p for _, p in at_scales(read_training(self.settings.training, self.system.object_shape, not_scene=scene), self.system.object_shape)]
        return self._cache[key]

    def _lmmse(self, sigma, scene):
        from plenocli.solvers import lmmse, natural

        pictures = self._training(scene)
        if ("statistics", scene) not in self._cache:
            count = PATCHES_A_POINT * self.system.own.shape[1]
            patches = natural.draw_patches(pictures, self.system.object_shape, count, stream(self.settings.seed, "reconstruct"))
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


def _floor(y):
    """The least noise that is believed: rounding of the data."""
    return max(1e-9 * float(np.abs(y).max(initial=0)), np.finfo(float).tiny)
