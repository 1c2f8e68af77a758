"""Methods of reconstruct that see all lenslets together: total variation, plug and play."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from plenocli.base.progress import bar
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture import error_bars, footprint
from plenocli.inverse.picture.estimators import Estimators, root_mean_square
from plenocli.inverse.picture.methods.method import Estimate, Estimator, OwnLight, Sees
from plenocli.inverse.picture.methods.per_lenslet import adaptive_lmmse
from plenocli.inverse.picture.solvers import whole_sensor

LOUD = 80
"""Directions of a superpixel in which photographs stand above the noise, up to which the start
looks over 3x3 lenslets. With more the lenslet itself tells what its neighbours could, to 0.03 dB.
"""

LOOK = 34
"""Points around one that decide on it: twice the reach of block matching, whose later rounds hardly
change the picture.
"""

Solve = Callable[
    [Estimators, whole_sensor.DataTerm, np.ndarray, float], tuple[np.ndarray, str, int]
]
"""(estimators, data term, picture to start from, error expected of it) -> (picture, rule, rounds).
"""


@dataclass(frozen=True, kw_only=True)
class WholePictureStats:
    """What a method of the whole picture did.

    expected_error: root mean square error that LMMSE, from which it starts, expects of itself.
    wide: whether that looked at 3x3 lenslets.
    rounds: of turns between data and prior.
    rule: in words.
    device: the graphics card on which it did it; None: a processor.
    """

    expected_error: float
    rounds: int
    rule: str
    wide: bool = False
    device: str | None = None

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        over = " over 3x3 lenslets" if self.wide else ""
        start = f"lmmse{over}, which expects an error of {self.expected_error:.3g}"
        told = {"start": start, "rule": self.rule}
        return told if self.device is None else told | {"device": self.device}


def total_variation(
    estimators: Estimators, term: whole_sensor.DataTerm, start: np.ndarray, error: float
) -> tuple[np.ndarray, str, int]:
    """Isotropic total variation from the picture `start`, whose error is about `error`."""
    rounds = range(whole_sensor.TV_ROUNDS)
    picture = whole_sensor.total_variation(term, start, error, bar(rounds, len(rounds), "rounds"))
    rule = "isotropic total variation, weight by the error that lmmse expects"
    return picture, rule, len(rounds)


def plug_and_play(
    estimators: Estimators, term: whole_sensor.DataTerm, start: np.ndarray, error: float
) -> tuple[np.ndarray, str, int]:
    """Block matching in turns with the data, from the picture `start`, whose error is about
    `error`.
    """
    taus = whole_sensor.schedule(error)
    denoise = whole_sensor.denoiser(estimators.prior.bands())
    there, rounds = estimators.device, bar(taus, len(taus), "rounds")
    picture = there.get(
        whole_sensor.plug_and_play(term.on(there), there.put(start), denoise, rounds)
    )
    rule = f"{len(taus)} rounds of block matching, from {taus[0]:.3g} to {taus[-1]:.3g}"
    return picture, rule, len(taus)


def _from_lmmse(
    solve: Solve,
    factor: float,
    estimators: Estimators,
    light: OwnLight,
    *,
    wide: bool = False,
    on_device: bool = False,
) -> Estimate:
    """The Estimate of `solve`, started from LMMSE.

    factor: of its standard deviation, see error_bars.
    wide: whether that may look over 3x3 lenslets, where the noise leaves something to be learnt
        from neighbours.
    on_device: whether it takes the device of the estimators.
    """
    shape, y, inner, joint = estimators.system.object_shape, light.y, light.inner, light.joint
    noise = light.data.known_sigma
    if joint is None:
        x, sigma = np.empty((2, *y.shape[:2], estimators.svd.vt.shape[1]))
    else:
        x, sigma = joint.value.copy(), joint.sigma.copy()
    prior, scene = estimators.prior, light.data.scene
    wide = wide and estimators.options.overlap != 1 and prior.heard(noise, scene).shape[1] <= LOUD
    if wide:
        around = prior.joint(noise, scene).apply(light.data.y, light.data.common)
        x[inner], sigma[inner] = around[0][inner], around[1][inner]
    else:
        x[inner], sigma[inner] = adaptive_lmmse(estimators, light.data, y[inner])
    counted = sigma[inner].reshape(-1, sigma.shape[2])[light.counted]
    error = float(np.sqrt(light.data.common("start", lambda: np.mean(counted**2))))
    found, rule, rounds = x.copy(), "", 0
    if not light.data.only_means:
        reach, held = -(-LOOK // min(shape)), None
        own = (part.indices(n) for part, n in zip(light.data.own, y.shape))
        near = tuple(slice(max(0, first - reach), last + reach) for first, last, _ in own)
        if joint is not None:
            edge = np.ones(y.shape[:2], bool)
            edge[inner] = False
            held = edge[near], x[near]
        term = whole_sensor.DataTerm(estimators.svd, shape, y[near], noise, 2 * error, held)
        picture, rule, rounds = solve(estimators, term, to_plane(x[near], shape), error)
        found[near] = to_blocks(picture, shape)
    sigma[inner] = error_bars.of_picture(estimators, light.data, y[inner], found[inner], factor)
    return Estimate(
        value=found,
        sigma=sigma,
        from_lmmse=root_mean_square(found - x),
        stats=WholePictureStats(
            expected_error=error,
            rounds=rounds,
            rule=rule,
            wide=wide,
            device=estimators.device.name if on_device else None,
        ),
    )


TV = Estimator(
    name="tv",
    sees=Sees.PICTURE,
    phases=footprint.tv_phases,
    weighs_all=True,
    points_around=LOOK,
    estimate=partial(_from_lmmse, total_variation, error_bars.BY_VARIATION),
)
PNP = Estimator(
    name="pnp",
    sees=Sees.PICTURE,
    phases=footprint.pnp_phases,
    options=("device",),
    weighs_all=True,
    points_around=LOOK,
    estimate=partial(_from_lmmse, plug_and_play, error_bars.BY_MATCHING, wide=True, on_device=True),
)
