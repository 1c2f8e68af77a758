"""`--method auto`: candidates are tried on pieces of training photographs, and
the best is taken.
"""

import numpy as np

from plenocli.base.progress import note
from plenocli.base.random_streams import stream
from plenocli.base.tiling import to_blocks
from plenocli.inverse.picture.lenslet_model import Superpixels

TRIALS, SIDE = 5, 3
"""Pieces of training pictures, of so many lenslets a side, on which the candidates are tried."""
MARGIN = 0.05
"""dB by which a method must be better in the trial to be taken instead of lmmse."""
SLOW = 2000
"""Lenslets from which on the time of whole-picture methods is told beforehand."""


def choose(camera, data, kept):
    """{"method", "reason", "trial_db"} for this noise: the best of the candidates on pieces of
    photographs, seen by this camera.

    What is compared is measured, not promised: TRIALS pieces of training pictures, of about the
    capture's contrast, are captured by the own block of `camera` (Estimators) with the noise of
    this capture, relative to the signal, and reconstructed by each candidate. lmmse has seen these
    pictures in its covariance, so that a method that wins wins in earnest; what a dictionary was
    learnt from flatters it and is left out.
    kept: a dict, where trials are kept for captures to come.
    """
    sigma = camera.noise(data, {})
    # an empty capture is all noise
    loudness = max(np.sqrt(np.mean(np.square(data.y))), 1e-3 * sigma)
    key = (float(f"{sigma / loudness:.1e}"), _contrast(camera, data, sigma), data.scene)
    if key not in kept:
        kept[key] = _trial(camera, *key)
    quality = kept[key]
    if not quality:
        return {
            "method": "lmmse",
            "reason": "the training pictures are too small for a trial of others",
        }
    best = max(quality, key=quality.get)
    best = best if quality[best] > quality["lmmse"] + MARGIN else "lmmse"
    told = ", ".join(f"{m} {q:.1f} dB" for m, q in quality.items())
    lenslets = data.y.shape[0] * data.y.shape[1]
    if best == "pnp" and lenslets > SLOW:
        note(
            f"pnp of {lenslets} lenslets takes about "
            f"{lenslets * camera.system.own.shape[1] * 1e-4 / 60:.0f} minutes of CPU; "
            "--method lmmse takes seconds"
        )
    return {
        "method": best,
        "reason": f"best on pieces of training photographs at this noise ({told})",
        "trial_db": quality,
    }


def _contrast(camera, data, sigma):
    """Variance within a lenslet over its squared brightness, as LMMSE sees this capture; in
    powers of two, that captures share trials.
    """
    y = camera.without_stray(data.y)
    y = y.reshape(-1, y.shape[2]).T
    estimator = camera.prior.lmmse(sigma, data.scene)
    bright = max(float(np.mean(estimator.brightness(y))), 1e-6)
    return 2.0 ** round(np.log2(estimator.common_scale(y) * estimator.variance.mean() / bright**2))


def _coloured(truth, bands, rng):
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


def _trial(camera, relative, contrast, scene):
    """PSNR (dB) of each candidate over pieces of about this contrast, {} where no
    picture is large enough.

    A dictionary's is that of lmmse and what it gains over lmmse on pictures it was not learnt from.
    """
    quality = _compare(camera, ("lmmse", "pnp"), (), relative, contrast, scene)
    if camera.settings.dictionary is not None:
        fresh = _compare(
            camera,
            ("lmmse", "dictionary"),
            camera.learnt.training,
            relative,
            contrast,
            scene,
        )
        if not fresh:
            note(
                "auto does not try the dictionary: it was learnt from all training pictures that "
                "are large enough (give others with --training, or --method dictionary)"
            )
        elif quality:
            quality["dictionary"] = quality["lmmse"] + fresh["dictionary"] - fresh["lmmse"]
    return quality


def _compare(camera, candidates, without, relative, contrast, scene):
    """Mean PSNR (dB) of each candidate over pieces of about this contrast from pictures but
    those named in `without`, {} where none is large enough.
    """
    from plenocli.inverse.prior.natural_images import draw_patches

    shape = camera.system.object_shape
    side = tuple(SIDE * n for n in shape)
    large = [
        p
        for p in camera.prior.pictures(scene, without)
        if p.shape[0] >= side[0] and p.shape[1] >= side[1]
    ]
    if not large:
        return {}
    rng = stream(camera.settings.seed, "trial")
    pieces = draw_patches(large, side, 16 * TRIALS, rng).T.reshape(-1, *side)
    within = [to_blocks(p, shape).var(axis=2).mean() / max(p.mean() ** 2, 1e-12) for p in pieces]
    alike = np.argsort(np.abs(np.log(np.maximum(within, 1e-12) / contrast)), kind="stable")[:TRIALS]
    truth = _coloured(
        to_blocks(np.concatenate([pieces[k] for k in alike], axis=1), shape),
        camera.system.bands,
        rng,
    )
    y = truth @ camera.system.own.T
    sigma = relative * float(np.sqrt(np.mean(y**2)))
    y += sigma * rng.standard_normal(y.shape)
    alone, data, quality = camera.alone(sigma), Superpixels(y=y, sigma=sigma, scene=scene), {}
    for method in candidates:
        error = (
            np.square(alone.run(method, data, None, {})[0] - truth)
            .reshape(SIDE, TRIALS, -1)
            .mean(axis=(0, 2))
        )
        quality[method] = float(np.mean(-10 * np.log10(np.maximum(error, 1e-12))))
    return quality
