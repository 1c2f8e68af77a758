"""plan: the cheapest chain from a camera and its capture to a picture that is predicted to lose
little against the best one.
"""

from __future__ import annotations

import math
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import ConfigError

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.inverse.chain.choose import ChainPlan, Weighed

MOST_SHOWN = 24
"""Chains that people are shown, those that lose least."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line says beside the files.

    quality_loss: dB of PSNR that may be lost against the best chain.
    snr_db: of the capture's white noise, None for the sensor's at full well.
    capture: file that the commands name.
    seed: of the rehearsal.
    """

    quality_loss: float
    snr_db: float | None = None
    capture: str = "capture.h5"
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class PlanReport:
    """What was planned.

    plan: the chains with what they are predicted to cost and lose.
    commands: lines of a shell that carry the chosen one out.
    cpu_seconds: that planning took.
    """

    plan: ChainPlan
    commands: tuple[str, ...]
    cpu_seconds: float

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        plan = self.plan
        return {
            "quality_loss_db": plan.allowed,
            "noise_relative": plan.noise,
            "rehearsed_lenslets": plan.lenslets,
            "rehearsals": plan.runs,
            "cpu_seconds": self.cpu_seconds,
            "commands": list(self.commands),
            "chains": [
                {
                    "model": w.chain.matrix.model,
                    "accuracy": w.chain.matrix.accuracy,
                    "superpixels": list(w.chain.matrix.superpixels),
                    "method": w.chain.method,
                    "seconds": w.chain.seconds,
                    "bytes": w.chain.bytes,
                    "loss_db": w.loss,
                    "rehearsed": w.rehearsed,
                    "chosen": w is plan.chosen,
                    "best": w is plan.best,
                }
                for w in plan.weighed
            ],
        }

    def lines(self) -> str:
        """For people and for sh: everything but the commands is a comment."""
        from plenocli.inverse.chain.choose import aimed_at

        plan = self.plan
        shown = sorted(plan.weighed, key=lambda w: w.loss)[:MOST_SHOWN]
        shown += [w for w in (plan.chosen,) if w not in shown]
        rows = [["model", "accuracy", "superpixels", "method", "time", "memory", "loss", ""]]
        rows += [_row(w, plan) for w in sorted(shown, key=lambda w: w.chain.seconds)]
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        table = ["  ".join(c.ljust(n) for c, n in zip(row, widths)).rstrip() for row in rows]
        head = (
            f"at most {plan.allowed:g} dB below the best chain, at a noise of {plan.noise:.2g} of "
            f"the signal; {plan.runs} pictures of {plan.lenslets} lenslets rehearsed in "
            f"{self.cpu_seconds:.1f} s"
        )
        aim = (
            f"chosen is the cheapest that is predicted to lose at most {aimed_at(plan.allowed):.3g}"
            " dB, or the best: rehearsals miss by a little"
        )
        hidden = len(plan.weighed) - len(shown)
        more = [f"and {hidden} that lose more"] if hidden else []
        return "\n".join([*(f"# {line}" for line in (head, aim, *table, *more)), *self.commands])


def _row(weighed: Weighed, plan: ChainPlan) -> list[str]:
    chain = weighed.chain
    marks = ["chosen"] * (weighed is plan.chosen) + ["best"] * (weighed is plan.best)
    return [
        chain.matrix.model,
        f"{chain.matrix.accuracy:g}",
        "x".join(map(str, chain.matrix.superpixels)),
        chain.method,
        f"{chain.seconds:.2g} s",
        f"{chain.bytes / 2**20:.0f} MiB",
        f"{weighed.loss:.2f} dB{'' if weighed.rehearsed else ' about'}",
        ", ".join(marks),
    ]


def run_plan(camera_path: Path | str, scene: Path | str, settings: Settings) -> PlanReport:
    """Predict what chains cost and lose, and choose.

    camera_path: description, TOML.
    scene: photograph that stands for what will be captured, as read_scene takes it.

    Nothing is written. Raises ConfigError for cameras whose object has several bands or whose
    superpixels do not tile the sensor, InputError for files, NumericsError where no chain serves.
    """
    from plenocli.base.budget import one_thread
    from plenocli.files.read.cameras import read_camera
    from plenocli.files.read.scenes import read_scene
    from plenocli.files.read.training import read_training
    from plenocli.forward.accuracy.scene_needs import sensor_noise
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant
    from plenocli.forward.sensor.exposure.options import ExposureOptions
    from plenocli.forward.sensor.exposure.simulate import require_tiling
    from plenocli.inverse.chain.chains import chains_of, matrix_options
    from plenocli.inverse.chain.choose import choose
    from plenocli.inverse.chain.rehearsal import Rehearsal

    start = time.process_time()
    camera = read_camera(camera_path)
    _require_one_picture(camera, camera_path)
    require_tiling(camera, camera_path)
    snr = settings.snr_db
    if snr is None:
        snr = -20 * math.log10(sensor_noise(camera))
    noise = 10 ** (-snr / 20)
    shape = camera.object.samples_per_lenslet
    with one_thread():
        matrices = matrix_options(camera, noise)
        rehearsal = Rehearsal(
            camera,
            broadband(camera, lambda w: illuminant(camera.light.illuminant, w)),
            read_scene(str(scene)),
            ExposureOptions(snr_db=snr),
            lambda not_scene: read_training((), shape, not_scene=not_scene),
            matrices[-1],
            name=str(scene),
            seed=settings.seed,
        )
        plan = choose(chains_of(camera, matrices), rehearsal, settings.quality_loss)
    commands = plan.chosen.chain.commands(
        shlex.quote(str(camera_path)), shlex.quote(settings.capture)
    )
    return PlanReport(plan=plan, commands=tuple(commands), cpu_seconds=time.process_time() - start)


def _require_one_picture(camera: Camera, where: Path | str) -> None:
    """ConfigError for a camera whose objects have colour, or several wavelengths."""
    if camera.filter_array is not None or camera.sensor.cfa != "mono":
        raise ConfigError(
            "tells colours apart: plan rehearses pictures of one band, and no spectra",
            where,
            "choose by hand: sweep sample_configs/sweeps/trade_spectral.toml shows what each "
            "way costs",
        )
    if len(camera.light.wavelengths) > 1 and camera.light.band is None:
        raise ConfigError(
            "has several wavelengths: plan rehearses pictures of one",
            where,
            "leave one in [light] wavelengths, or give their band",
        )
