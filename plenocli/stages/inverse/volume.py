"""volume: a specimen in three dimensions from one capture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from plenocli.base.errors import UsageError
from plenocli.base.progress import note
from plenocli.base.text import Record, by
from plenocli.base.units import format_length

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.results.volumes import StoredVolume
    from plenocli.files.scratch import Scratch
    from plenocli.forward.volume.stack import Stack
    from plenocli.inverse.volume.measurement import Measurement
    from plenocli.inverse.volume.tiles import Tiles
    from plenocli.inverse.volume.volume import Trial, Volume

WORTH_SAYING = 5e-3
"""Share of the light from which on haze is told."""
CLEARER_DB = 3.0
"""By which held-out pixels are predicted better than those of the volume that this one is tied to,
from which on that is told.
"""
SUFFIXES = (".h5", ".tif", ".tiff")


@dataclass(frozen=True, kw_only=True)
class VolumeSummary(Record):
    """What volume made.

    shape: planes, rows, columns.
    depths: of the planes, m.
    method: that was taken; tried: (what, misfit of held-out pixels) of all that were tried.
    explained_db: of the variance of held-out pixels; None where none were held out.
    held_by_bars: share of them within 95 % bars, by quartile of brightness, darkest first.
    margin: lenslets from the border on which light is missing.
    like_factor: times the volume of --like, what is tied to it; 0 where nothing is.
    like_share: of the total variation, that this explains; both None without --like.
    """

    output: str
    shape: list[int]
    depths: list[float]
    method: str
    tried: list[tuple[str, float]]
    explained_db: float | None
    held_by_bars: list[float] | None
    margin: int
    like_factor: float | None
    like_share: float | None

    def line(self) -> str:
        """One sentence for people."""
        planes, rows, columns = self.shape
        text = f"{self.output}: {planes} planes of {rows} x {columns} voxels by {self.method}"
        if self.explained_db is not None and self.held_by_bars is not None:
            text += (
                f"; held-out pixels are predicted to {self.explained_db:.1f} dB of their variance, "
                f"95 % bars hold {min(self.held_by_bars):.0%} to {max(self.held_by_bars):.0%} of "
                "them by brightness"
            )
        if self.like_factor is not None and self.like_share is not None:
            text += (
                f"; {self.like_factor:.3g} of the other volume is {self.like_share:.0%} of what "
                "varies"
                if self.like_factor
                else "; it is not tied to the other volume: its structure is another, or held-out "
                "pixels object"
            )
        some = "1 lenslet along the border misses light"
        if self.margin != 1:
            some = f"{self.margin} lenslets along the border miss light"
        return f"{text}; {some}"


def run_volume(
    capture: Path | str,
    output: Path | str,
    pif: Path | str,
    *,
    calibration: Path | str | None = None,
    method: str = "auto",
    hold_out: float = 0.05,
    background: float | Literal["auto"] = "auto",
    most_planes: int | None = None,
    channel: str | None = None,
    like: Path | str | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    seed: int = 0,
    command: str = "",
) -> VolumeSummary:
    """Make a volume of one capture and write it.

    capture: mosaic, raw file or capture artefact.
    output: .h5, or .ome.tif for Fiji and its kin.
    pif: kernels of kind pif-stack, from simulate-pif.
    calibration: lenslet grid and white image; a simulated capture needs none.
    method: "auto", "rl", "lmmse", "tv" or "tikhonov".
    hold_out: share of the pixels that are put aside to judge by.
    background: signal without any specimen, in units of white; "auto": the haze of the darkest
        lenslets, where that predicts the held-out pixels better.
    most_planes: keep the planes that predict held-out pixels best, no more than this; None: all.
    channel: letter of a colour sensor's pixels that are taken, each at its own place.
    like: volume (.h5) of another colour of the same specimen, on the same voxels and clearer, whose
        structure this one may share; for total variation, then the method of "auto".
    device: "cpu" or "cuda", where the kernels' map multiplies and transforms.

    Raises UsageError, InputError, NumericsError where memory does not suffice, OutputError.
    """
    from plenocli.base.device import device as device_of
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.bench import clear
    from plenocli.files.results.stacks import read_stack
    from plenocli.files.results.volumes import read_volume, same_voxels
    from plenocli.files.scratch import Scratch
    from plenocli.inverse.volume.tiles import Tiles

    output = Path(output)
    inputs = {"capture": capture, "pif": pif, "calibration": calibration, "like": like}
    check_output(output, overwrite=overwrite, inputs=list(inputs.values()), suffixes=SUFFIXES)
    if like is not None and method not in ("auto", "tv"):
        raise UsageError("volumes are tied by total variation alone", "--method", "leave it out")
    other = None if like is None else read_volume(like, in_file=True)
    there = device_of(device)
    stack = read_stack(pif)
    room = Scratch(output)
    measurement = _looked_at(
        capture,
        stack,
        calibration,
        background=0.0 if background == "auto" else background,
        channel=channel,
        room=room,
    )
    (rows, columns), several = measurement.signal.shape[:2], stack.lenslets
    note(
        f"{rows * several} x {columns} lenslets, {len(stack.depth)} planes of "
        f"{stack.point_shape[0] // several} x {stack.point_shape[1]} voxels a lenslet"
    )
    trials: tuple[Trial, ...] = ()
    how: dict[str, Any] = dict(hold_out=hold_out, seed=seed, where=pif, device=there, room=room)
    method = method if like is None else "tv"
    tiles = Tiles(stack, measurement, method, **how)
    if most_planes is not None:
        stack, trials = _supported(tiles, most_planes)
        tiles = Tiles(stack, measurement, method, **how)
    if other is not None:
        tiles.like = same_voxels(other, stack, (rows, columns), str(like))
    _say_windows(tiles)
    if background == "auto":
        _take_haze(tiles)
    files, settings = describe_inputs(inputs), (hold_out, background, most_planes, channel, seed)
    _keep(output, tiles, (*settings, there.name, files))
    volume = tiles.volume()
    volume = replace(volume, trace=(*trials, *volume.trace))
    provenance = Provenance(
        command=command, inputs=files, seed=seed, accuracy=stack.accuracy.as_json()
    )
    _write(output, volume, stack, provenance, overwrite, there.name)
    clear(output)
    summary = _summary(output, volume, stack)
    if other is not None and summary.explained_db is not None:
        _tell_of_the_clearer(summary.explained_db, other, str(like))
    return summary


def _looked_at(
    capture: Path | str,
    stack: Stack,
    calibration: Path | str | None,
    *,
    background: float,
    channel: str | None,
    room: Scratch,
) -> Measurement:
    """Superpixels of a capture in `room`; what they are made of is let go."""
    from plenocli.files.images.mosaic import capture_in_file
    from plenocli.files.read.calibrations import read_images
    from plenocli.inverse.volume.superpixels import measured

    known, cfa = None, None
    if calibration is not None:
        known = read_images(calibration, small=True, superpixels=True)
        cfa = known.sensor.cfa
    return measured(
        capture_in_file(capture, cfa=cfa, room=room),
        stack,
        known,
        where=calibration,
        background=background,
        channel=channel,
        room=room,
    )


def _summary(output: Path, volume: Volume, stack: Stack) -> VolumeSummary:
    from plenocli.inverse.volume.volume import all_known

    held, likeness = volume.held_out, volume.likeness
    explained = None if held is None else all_known([held.explained_db])
    return VolumeSummary(
        output=str(output),
        shape=list(volume.value.shape),
        depths=stack.depth.tolist(),
        method=volume.method,
        tried=[(trial.what, trial.misfit) for trial in volume.trace],
        explained_db=None if explained is None else explained[0],
        held_by_bars=None if held is None else all_known(held.held_by_bars),
        margin=volume.margin,
        like_factor=None if likeness is None else likeness.factor,
        like_share=None if likeness is None else likeness.share,
    )


def _tell_of_the_clearer(explained_db: float, other: StoredVolume, path: str) -> None:
    """Say so where the other volume, by its held-out pixels, is the less clear one."""
    others_db = other.facts.get("held_out.explained_db")
    if others_db is not None and others_db < explained_db - CLEARER_DB:
        note(
            f"{path}: held-out pixels are predicted to {others_db:.1f} dB there and to "
            f"{explained_db:.1f} dB here: tie that volume to this one, not this one to it"
        )


def _supported(tiles: Tiles, most: int) -> tuple[Stack, tuple[Trial, ...]]:
    """The kernels of the planes that predict held-out pixels best, and what was tried."""
    from plenocli.inverse.volume.choose import supported_planes

    whole = tiles.stack
    chosen, trials = supported_planes(
        lambda planes: tiles.of(whole.only(planes)), len(whole.depth), most
    )
    stack = whole.only(chosen)
    places = ", ".join(format_length(depth) for depth in stack.depth.tolist())
    note(f"the capture supports {len(chosen)} of the planes: {places}")
    return stack, trials


def _say_windows(tiles: Tiles) -> None:
    """Say in how many windows it is done."""
    if len(tiles.windows) > 1:
        size = by(tiles.windows[0].weight.shape)
        note(f"in {len(tiles.windows)} windows of {size} lenslets: --mem-limit allows no more")


def _keep(output: Path, tiles: Tiles, depends: Any) -> None:
    """Have the volumes of several windows kept until the result is written.

    depends: all that they depend on, beside the windows.
    """
    from plenocli.files.bench import Bench
    from plenocli.stages.inverse.kept_windows import kept_part

    if len(tiles.windows) > 1:
        places = [(w.rows, w.columns) for w in tiles.windows]
        bench = Bench.beside(output, (depends, tiles.method, places))
        tiles.keep = partial(kept_part, bench)


def _take_haze(tiles: Tiles) -> None:
    """Take haze off, where held-out pixels agree, and say how much it was."""
    share = tiles.without_haze()
    if share > WORTH_SAYING:
        note(
            f"{share:.0%} of the light is haze, much the same behind all lenslets: it is taken "
            "off (--background 0 keeps it)"
        )


def _write(
    path: Path,
    volume: Volume,
    stack: Stack,
    provenance: Provenance,
    overwrite: bool,
    device: str | None,
) -> None:
    """The volume as artefact or OME-TIFF."""
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.images.tiff_stack import write_volume_tiff
    from plenocli.files.results.volumes import volume_artefact

    if path.suffix == ".h5":
        made = volume_artefact(volume, stack.depth, stack.spacing, stack.point_shape, provenance)
        made.attrs["volume"] |= {} if device is None else {"device": device}
        write_artefact(path, made, overwrite=overwrite)
        return
    rows, columns = stack.spacing.mean(axis=0).tolist()
    write_volume_tiff(
        path, volume.value, volume.sigma, stack.depth, (rows, columns), overwrite=overwrite
    )
