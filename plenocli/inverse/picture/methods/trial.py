"""`--method auto`: candidates are tried on pieces of training photographs, and the best is taken.

What is compared is measured, not promised: pieces of training pictures, of about the capture's
contrast, are captured by the own block with the noise of this capture, relative to the signal, and
reconstructed by each candidate. lmmse has seen these pictures in its covariance and is taken only
where it leads; what a dictionary was learnt from flatters it and is left out. Pieces have no
neighbours, so that plug and play starts from LMMSE of each lenslet there; on a capture it may look
over 3x3 lenslets, which is better.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from plenocli.base.progress import note
from plenocli.base.random_streams import stream
from plenocli.base.tiling import to_blocks
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture import footprint
from plenocli.inverse.picture.estimators import Estimators, TrialKey
from plenocli.inverse.picture.footprint import Sizes
from plenocli.inverse.picture.joint import JointEstimate
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.picture.methods.method import Method, Sees
from plenocli.inverse.picture.methods.per_lenslet import DICTIONARY, LMMSE
from plenocli.inverse.picture.methods.whole_picture import PNP
from plenocli.inverse.picture.reconstruction import Choice, Reconstruction
from plenocli.inverse.prior.natural_images import draw_patches

TRIALS, SIDE = 5, 3
"""Pieces of training pictures, of so many lenslets a side, on which the candidates are tried."""
LEAD = 0.2
"""dB by which lmmse must lead in the trial to be taken: it has seen these pictures, and five pieces
are few.
"""
SLOW = 2000
"""Lenslets from which on the time of whole-picture methods is told beforehand."""


@dataclass(frozen=True, kw_only=True)
class Trial(Method):
    """The best of some methods at a capture's noise and contrast.

    fallback: the method that the others must beat.
    others: that are tried.
    with_dictionary: that is tried where there is a dictionary.
    """

    fallback: Method
    others: tuple[Method, ...]
    with_dictionary: Method

    def reconstruct(
        self,
        estimators: Estimators,
        data: Superpixels,
        truth: np.ndarray | None = None,
        choice: Choice | None = None,
        joint: JointEstimate | None = None,
    ) -> Reconstruction:
        """As in Method, by the method that does best in the trial."""
        name, choice = data.common("method", lambda: self._chosen(estimators, data))
        method = self._by_name[name]
        return method.reconstruct(estimators, data, truth, choice, joint)

    @property
    def _by_name(self) -> dict[str, Method]:
        return {m.name: m for m in (self.fallback, *self.others, self.with_dictionary)}

    def _chosen(self, estimators: Estimators, data: Superpixels) -> tuple[str, Choice]:
        method, choice = self.choose(estimators, data)
        return method.name, choice

    def choose(self, estimators: Estimators, data: Superpixels) -> tuple[Method, Choice]:
        """The best method for a capture, and why; trials are kept for captures to come."""
        sigma = data.known_sigma
        # an empty capture is all noise
        loudness = max(np.sqrt(np.mean(np.square(data.y))), 1e-3 * sigma)
        key = (float(f"{sigma / loudness:.1e}"), _contrast(estimators, data, sigma), data.scene)
        if key not in estimators.trials:
            estimators.trials[key] = self._try_all(estimators, key)
        quality = estimators.trials[key]
        if not quality:
            return self.fallback, Choice(
                method=self.fallback.name,
                reason="the training pictures are too small for a trial of others",
            )
        best = self._by_name[max(quality, key=lambda name: quality[name])]
        rule = "best"
        if best is self.fallback:
            close = max(self.others, key=lambda m: quality[m.name])
            if quality[best.name] < quality[close.name] + LEAD:
                best, rule = close, f"no worse than {best.name}, which was taught by them,"
        lenslets = data.y.shape[0] * data.y.shape[1]
        if best.sees is Sees.PICTURE and lenslets > SLOW:
            note(
                f"{best.name} of {lenslets} lenslets takes about "
                f"{lenslets * estimators.system.own.shape[1] * 1e-4 / 60:.0f} minutes of CPU; "
                f"--method {self.fallback.name} takes seconds"
            )
        told = ", ".join(f"{name} {db:.1f} dB" for name, db in quality.items())
        return best, Choice(
            method=best.name,
            reason=f"{rule} on pieces of training photographs at this noise ({told})",
            trial_db=quality,
        )

    def _try_all(self, estimators: Estimators, key: TrialKey) -> dict[str, float]:
        """PSNR (dB) of each candidate over pieces of about this contrast, {} where no picture is
        large enough.

        A dictionary's is that of the fallback and what it gains over it on pictures it was not
        learnt from.
        """
        quality = _compare(estimators, (self.fallback, *self.others), (), key)
        if estimators.read_dictionary is None:
            return quality
        first, other = self.fallback.name, self.with_dictionary.name
        fresh = _compare(
            estimators, (self.fallback, self.with_dictionary), estimators.learnt.training, key
        )
        if not fresh:
            note(
                "auto does not try the dictionary: it was learnt from all training pictures that "
                "are large enough (give others with --training, or --method dictionary)"
            )
        elif quality:
            quality[other] = quality[first] + fresh[other] - fresh[first]
        return quality


def _contrast(estimators: Estimators, data: Superpixels, sigma: float) -> float:
    """Variance within a lenslet over its squared brightness, as LMMSE sees this capture; in
    powers of two, that captures share trials.
    """
    y = estimators.without_stray(data.y)
    y = y.reshape(-1, y.shape[2]).T
    lmmse = estimators.prior.lmmse(sigma, data.scene)
    bright = max(float(np.mean(lmmse.brightness(y))), 1e-6)
    return 2.0 ** round(np.log2(lmmse.common_scale(y) * lmmse.variance.mean() / bright**2))


def _coloured(truth: np.ndarray, bands: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    """Grey blocks (lenslet_row, lenslet_column, point) with points in several bands, each piece
    in the colour of some surface.
    """
    from plenocli.forward.scene.tables import surfaces

    if len(bands) < 2:
        return truth
    colours = surfaces(np.array(bands))
    colours = colours[rng.choice(len(colours), TRIALS, replace=False)]
    colours = np.repeat(colours / colours.mean(axis=1, keepdims=True), SIDE, axis=0)
    return (truth[:, :, None, :] * colours[:, :, None]).reshape(*truth.shape[:2], -1)


def _compare(
    estimators: Estimators,
    candidates: tuple[Method, ...],
    without: Collection[str],
    key: TrialKey,
) -> dict[str, float]:
    """Mean PSNR (dB) of each candidate over pieces of about the key's contrast from pictures but
    those named in `without`, {} where none is large enough.
    """
    (relative, contrast, scene), system = key, estimators.system
    shape = system.object_shape
    side = (SIDE * shape[0], SIDE * shape[1])
    large = [
        p
        for p in estimators.prior.pictures(scene, without)
        if p.shape[0] >= side[0] and p.shape[1] >= side[1]
    ]
    if not large:
        return {}
    rng = stream(estimators.options.seed, "trial")
    pieces = draw_patches(large, side, 16 * TRIALS, rng).T.reshape(-1, *side)
    within = [to_blocks(p, shape).var(axis=2).mean() / max(p.mean() ** 2, 1e-12) for p in pieces]
    alike = np.argsort(np.abs(np.log(np.maximum(within, 1e-12) / contrast)), kind="stable")[:TRIALS]
    grey = to_blocks(np.concatenate([pieces[k] for k in alike], axis=1), shape)
    truth = _coloured(grey, system.bands, rng)
    y = truth @ system.own.T
    sigma = relative * float(np.sqrt(np.mean(y**2)))
    y += sigma * rng.standard_normal(y.shape)
    alone, quality = estimators.alone(sigma), {}
    data = Superpixels(y=y, noise=Noise.of_sigma(sigma), scene=scene)
    for method in candidates:
        difference = method.reconstruct(alone, data).value - truth
        error = np.square(difference).reshape(SIDE, TRIALS, -1).mean(axis=(0, 2))
        quality[method.name] = float(np.mean(-10 * np.log10(np.maximum(error, 1e-12))))
    return quality


def _phases(n: Sizes) -> list[float]:
    """Of the candidates."""
    return [*footprint.pnp_phases(n), *footprint.dictionary_phases(n)]


AUTO = Trial(
    name="auto",
    sees=Sees.PICTURE,
    phases=_phases,
    needs_pif=False,
    options=("dictionary", "device"),
    points_around=PNP.points_around,
    fallback=LMMSE,
    others=(PNP,),
    with_dictionary=DICTIONARY,
)
