"""The methods of reconstruct: each is set up once and then serves every capture made
with the same camera.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.progress import bar, note
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture import noise_level, per_lenslet, trial
from plenocli.inverse.picture.solvers.joint_lmmse import by_lenslet
from plenocli.inverse.prior.scene_prior import ScenePrior

NOISY = ("tikhonov", "tsvd", "lmmse", "dictionary")
WHOLE = ("pnp", "tv")
"""Methods that reconstruct all lenslets together."""
CONTRAST = 0.1
"""What a point of a photograph differs from its lenslet's brightness, standard deviation: the
measure of what noise hides.
"""
HIDDEN = 3.0
"""What is wrong with a capture, over what is found of it: objects imitate the rest
(docs/model.md, "Spatial reconstruction").
"""
INNER = (slice(1, -1), slice(1, -1))


class Estimators:
    """Solvers for one system matrix (LensletMatrix) under the options of the
    command (stages.reconstruct.Settings).

    read_pictures: as in ScenePrior.
    read_learnt: gives the Dictionary, None where there is none.
    threads: of compiled code, None for all cores.
    elsewhere: set to send batches of lenslets to other processes, see `in_batches`.
    """

    elsewhere = None

    def __init__(self, system, settings, read_pictures, read_learnt=None, threads=None):
        self.system, self.settings, self.threads, self._trials = system, settings, threads, {}
        self.read_pictures, self.read_learnt = read_pictures, read_learnt
        self.coupled = len(system.offsets) > 1
        self.overlap = settings.overlap or (3 if self.coupled else 1)

    @cached_property
    def svd(self):
        from plenocli.inverse.picture.solvers.least_squares import decompose

        return decompose(self.system.own)

    @cached_property
    def prior(self):
        return ScenePrior(self.system, self.svd, self.read_pictures, self.settings.seed)

    @cached_property
    def learnt(self):
        return self.read_learnt()

    def solve(self, data, truth=None):
        """(x, sigma or None, report) of Superpixels: x (lenslet_row, lenslet_column, point), report
        a dict with "method".

        truth (like x): chooses the weight of tikhonov or tsvd with hindsight.
        """
        report = {"method": self.settings.method, "reason": "asked for"}
        if self.settings.method == "auto":
            report |= trial.choose(self, data, self._trials)
        return *self.run(report["method"], data, truth, report), report

    def seen(self, sigma):
        """(map, report): what of an object the own superpixel tells apart at noise `sigma`, points
        (row, column) from 0 (in the null space) to 1, mean of the bands; its mean, the directions
        that stand above the noise, and whether an object and itself turned look alike.
        """
        from plenocli.forward.propagation.diagnosis import SYMMETRY_WARNING, symmetry_defect
        from plenocli.inverse.picture.solvers.least_squares import resolution

        share = resolution(self.svd, sigma, CONTRAST).reshape(-1, *self.system.object_shape)
        report = {
            "share": float(share.mean()),
            "directions": int(np.count_nonzero(self.svd.s * CONTRAST > sigma)),
            "points": share.size,
        }
        if len(share) > 1:
            report["bands"] = share.mean(axis=(1, 2)).tolist()
        if symmetry_defect(self.system.own.reshape(-1, share[0].size)) < SYMMETRY_WARNING:
            report["symmetric"] = True
            note(
                "half of the object cannot be seen: object points opposite each other about the "
                "lenslet's axis give the same superpixel, and only their sum is measured (move "
                "the sensor out of the pupil's conjugate plane)"
            )
        return share.mean(axis=0), report

    def alone(self, sigma):
        """Estimators for the own superpixel without neighbours, at the given noise."""
        one = Estimators(
            replace(self.system, blocks=self.system.own[None], offsets=np.zeros((1, 2), int)),
            replace(self.settings, noise_sigma=sigma, overlap=1),
            self.read_pictures,
            None if self.read_learnt is None else lambda: self.learnt,
            self.threads,
        )
        one.svd, one.prior = self.svd, self.prior
        return one

    def run(self, method, data, truth, report):
        """(x, sigma or None) by one method; its parameters go to the report."""
        report["overlap"] = self.overlap
        if self.overlap == 3 and not self.coupled and method != "lmmse":
            note(
                "--overlap 3: the pif holds own superpixels only, so there is no neighbours' "
                "light to take away (simulate-pif --superpixels 3x3)"
            )
        if self.overlap == 1 and self.coupled and method != "block-mean":
            note(
                "--overlap 1: the neighbours' light, which the pif knows, stays in the "
                "superpixels and is taken for the object's; --overlap 3 takes it away"
            )
        if method == "lmmse":
            report["from_lmmse"] = 0.0
        if method == "lmmse" and self.overlap == 3:
            return self._jointly(data, report)
        if not self.coupled or self.overlap == 1 or method == "block-mean":
            return (
                self._whole(method, data, report)
                if method in WHOLE
                else self._by_lenslet(method, data, data.y, truth, report)
            )
        found = {}
        x, spread = self._jointly(data, found)
        if data.sigma is not None:
            report |= {k: found[k] for k in ("noise_sigma", "excess", "scale") if k in found}
        report["neighbours"] = "their light is taken away as LMMSE over 3x3 lenslets sees it"
        y = self._own_light(data.y, x)
        report["border"] = (
            "lenslets that lack neighbours are those of LMMSE over 3x3 lenslets: light from "
            "beyond the array cannot be taken away"
        )
        if min(y.shape[:2]) <= 2:
            return x, spread
        first = x.copy()
        if method in WHOLE:
            x, spread = self._whole(method, replace(data, y=y), report, (x, spread))
        else:
            x[INNER], _ = self._by_lenslet(
                method, data, y[INNER], None if truth is None else truth[INNER], report
            )
            spread = None
        report["from_lmmse"] = _rms(x - first)
        return x, spread

    def in_batches(self, solve, z, size, *options):
        """What solve(camera, batch, *options), a function of stages.per_lenslet, gives for z (row,
        signal), `size` signals at a time, in their order. Several batches go to elsewhere(solve,
        batches, options), where it is set.
        """
        # as they arrive elsewhere: last digits depend on the layout
        batches = [
            np.ascontiguousarray(z[:, start : start + size]) for start in range(0, z.shape[1], size)
        ]
        if self.elsewhere is not None and len(batches) > 1:
            return self.elsewhere(solve, batches, options)
        return [
            solve(self, batch, *options)
            for batch in bar(batches, len(batches), "batches of lenslets")
        ]

    def noise(self, data, report):
        """Standard deviation of what the estimate of all of the capture takes for noise
        (stages.noise_level); the report says which it is. A matrix with neighbours is believed
        first: the joint estimate tells better what is left over than block means do.
        """
        if self.coupled and data.sigma is not None:
            return self._noise(data, data.y, report, look=False)
        return self._noise(data, self.without_stray(data.y), report)

    def loss_db(self, data, report, error):
        """How much larger than what LMMSE expects of a capture that is A x and noise alone the
        error of the picture is at most, dB; None where that is not known, or where the method has
        no use for the statistics of photographs.

        error: of the matrix, root mean square of a pixel. HIDDEN times it and what the capture
            holds beyond noise (report["excess"]) may all fall upon the few directions that are
            seen, where noise has only their share of the pixels: with so much more noise LMMSE's
            error is reckoned. The picture of another method is off by no more than that and its
            distance from LMMSE's.
        """
        if "excess" not in report or "from_lmmse" not in report:
            return None
        share = max(1, np.count_nonzero(self.svd.s * CONTRAST > data.sigma)) / len(self.svd.u)
        wrong = HIDDEN * np.hypot(report["excess"], error) / np.sqrt(share)
        now, known = (
            self.prior.lmmse(float(sigma), data.scene).expected(report.get("scale", 1.0))
            for sigma in (np.hypot(data.sigma, wrong), data.sigma)
        )
        return 20 * float(np.log10((now + report["from_lmmse"]) / known))

    def without_stray(self, y):
        """y without the neighbours' light, as block means tell it: enough to estimate
        noise and contrast.
        """
        if not self.coupled:
            return y
        even = np.repeat(self.system.levels(y), int(np.prod(self.system.object_shape)), axis=2)
        return y - self._sensor(y.shape[:2]).neighbours_only().forward(even)

    def _noise(self, data, y, report, look=True):
        """The noise of superpixels y (lenslet_row, lenslet_column, pixel);

        look: for what no object gives. It is not less than what the joint estimate found before,
            which the report has.
        """
        if self.settings.noise_sigma is not None:
            report |= {
                "noise_sigma": float(self.settings.noise_sigma),
                "noise_source": noise_level.GIVEN,
            }
            return report["noise_sigma"]
        hint = (
            ""
            if self.coupled and self.overlap == 3
            else ". If it is the neighbours' light, use a pif of --superpixels 3x3 with --overlap 3"
        )
        stacked = y.reshape(-1, y.shape[-1]).T
        if not look:
            return noise_level.believed(y, data.sigma, None, report)
        found = max(
            noise_level.outside(self.svd, y, data.sigma) or 0.0, report.get("noise_sigma", 0.0)
        )
        return noise_level.believed(
            y,
            data.sigma,
            found,
            report,
            hint=hint,
            implausible=lambda sigma: self.prior.lmmse(sigma, data.scene).implausible(stacked),
        )

    def _sensor(self, count):
        return BlockToeplitz(self.system.blocks, self.system.offsets, count)

    def _own_light(self, y, x):
        """The superpixels y without the light that the objects x under their neighbours send;
        beyond the array x goes on mirrored.

        An estimate per lenslet cannot tell that light from its own and amplifies it; taking it away
        by repeated estimates diverges where the matrix is ill-conditioned, so that x comes from
        the joint estimate.
        """
        reach, shape = int(np.abs(self.system.offsets).max()), self.system.object_shape
        planes = to_plane(x, shape).reshape(-1, *(n * k for n, k in zip(y.shape[:2], shape)))
        beyond = to_blocks(
            np.pad(planes, [(0, 0), *((reach * k, reach * k) for k in shape)], mode="symmetric"),
            shape,
        )
        inside = tuple(slice(reach, reach + n) for n in y.shape[:2])
        return y - self._sensor(beyond.shape[:2]).neighbours_only().forward(beyond)[inside]

    def _by_lenslet(self, method, data, y, truth, report):
        """(x, sigma or None) of superpixels y (lenslet_row, lenslet_column,
        pixel), each by itself.
        """
        sigma = self._noise(data, y, report) if method in NOISY else None
        if method == "lmmse":
            return self._adaptive(sigma, data.scene, y)
        hidden = None if truth is None else truth.reshape(-1, truth.shape[2]).T
        return by_lenslet(
            lambda columns: per_lenslet.METHODS[method](self, columns, sigma, hidden, report), y
        ), None

    def _adaptive(self, sigma, scene, y):
        """(x, sigma) of LMMSE per lenslet, like y (lenslet_row, lenslet_column, pixel)."""
        rows, columns = y.shape[:2]
        x, spread, _ = self.prior.lmmse(sigma, scene).adaptive(y.reshape(rows * columns, -1).T)
        return x.T.reshape(rows, columns, -1), spread.T.reshape(rows, columns, -1)

    def _jointly(self, data, report):
        """(x, sigma) of LMMSE over 3x3 lenslets, the covariance scaled to this picture's contrast;
        once more where a matrix with neighbours leaves more over than the capture's noise.
        """
        sigma = self.noise(data, report)
        x, spread = self._scaled(data, sigma, report)
        if not self.coupled or report["noise_source"] != noise_level.TOLD:
            return x, spread
        more = noise_level.believed(data.y, data.sigma, self._left_over(data.y, x), report)
        return self._scaled(data, more, report) if more > sigma else (x, spread)

    def _scaled(self, data, sigma, report):
        """(x, sigma) of the joint estimate with scale x covariance, one scale a picture; steps of
        sqrt(2), so that captures of one kind share what is worked out. sigma goes by the geometric
        mean of that scale and the one of each lenslet's own light (docs/model.md,
        "Spatial reconstruction").
        """
        own = self.prior.lmmse(sigma, data.scene)
        y = self.without_stray(data.y)
        y = y[INNER] if min(y.shape[:2]) > 2 else y
        scale = own.common_scale(y.reshape(-1, y.shape[2]).T)
        # never above 1: light that the matrix does not produce passes for contrast, and
        # would be amplified
        scale = min(1.0, 2.0 ** (round(2 * np.log2(scale)) / 2))
        report["scale"] = scale
        x, spread = self.prior.joint(sigma / np.sqrt(scale), data.scene).apply(data.y)
        y = self._own_light(data.y, x) if self.coupled else data.y
        return x, spread * (scale * own.scales(y.reshape(-1, y.shape[2]).T)).reshape(
            *y.shape[:2], 1
        ) ** 0.25

    def _left_over(self, y, x):
        """Root mean square of y - A x over the lenslets that have all their neighbours
        (all, where none has).
        """
        rest = y - self._sensor(y.shape[:2]).forward(x)
        return _rms(rest[INNER] if rest[INNER].size else rest)

    def _whole(self, method, data, report, known=None):
        """(x, sigma) of a method that sees the whole picture; sigma is that of LMMSE, from which it
        starts: an upper estimate.

        data.y: own light.
        known: (x, sigma) of the estimate that took the neighbours' light away: lenslets of the
            border stay what they are there.
        """
        from plenocli.inverse.picture.solvers import whole_sensor as wholesensor

        shape, y = self.system.object_shape, data.y
        inner = np.s_[:, :] if known is None else INNER
        sigma = self._noise(data, y[inner], report)
        x, spread = known or np.empty((2, *y.shape[:2], self.svd.vt.shape[1]))
        x[inner], spread[inner] = self._adaptive(sigma, data.scene, y[inner])
        error = _rms(spread[inner])
        report["start"] = f"lmmse, which expects an error of {error:.3g}"
        held = None
        if known is not None:
            edge = np.ones(y.shape[:2], bool)
            edge[inner] = False
            held = edge, x.copy()
        term = wholesensor.DataTerm(self.svd, shape, y, sigma, 2 * error, held)
        if method == "tv":
            rounds = range(wholesensor.TV_ROUNDS)
            picture = wholesensor.total_variation(
                term, to_plane(x, shape), error, bar(rounds, len(rounds), "rounds")
            )
            report["rule"] = "isotropic total variation, weight by the error that lmmse expects"
        else:
            taus = wholesensor.schedule(error)
            picture = wholesensor.plug_and_play(
                term,
                to_plane(x, shape),
                wholesensor.denoiser(self.prior.bands()),
                bar(taus, len(taus), "rounds"),
            )
            report["rule"] = (
                f"{len(taus)} rounds of block matching, from {taus[0]:.3g} to {taus[-1]:.3g}"
            )
        found = to_blocks(picture, shape)
        if known is None:
            report["from_lmmse"] = _rms(found - x)
        return found, spread


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))
