"""Volumes, into their artefact and out of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.tiling import EVERYTHING, InParts
from plenocli.evaluation.metrics.volume import VolumeScore, score_volume

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.artefacts.reading import Stored
    from plenocli.forward.volume.stack import Stack
    from plenocli.inverse.volume.volume import Volume

SAME = 1e-3
"""Share of a size by which voxels may differ that are the same ones."""


@dataclass(frozen=True, kw_only=True)
class StoredVolume:
    """What a file says of a volume.

    value: (plane, row, column), may be PlanesInFile; sigma, opacity: likewise, or None.
    depth: (plane,) m; spacing: (rows, columns) m, mean over planes.
    facts: name of an attribute -> its value, those of held-out pixels with "held_out." before them.
    """

    value: Any
    sigma: np.ndarray | None
    opacity: np.ndarray | None
    depth: np.ndarray
    spacing: tuple[float, float]
    facts: dict[str, Any]

    @property
    def step(self) -> float:
        """m between planes; of a single one, between its rows."""
        return float(np.mean(np.diff(self.depth))) if len(self.depth) > 1 else self.spacing[0]

    @property
    def method(self) -> str | None:
        """That made it; None where it is known, not made."""
        return self.facts.get("method")

    @property
    def border(self) -> tuple[int, int]:
        """Voxels (rows, columns) along the border whose light is not all seen."""
        margin = int(self.facts.get("margin", 0))
        rows, columns = (int(n) for n in self.facts.get("point_shape", (1, 1)))
        return margin * rows, margin * columns


def truth_artefact(
    value: np.ndarray | InParts,
    depth: np.ndarray,
    spacing: np.ndarray,
    provenance: Provenance,
    opacity: np.ndarray | None = None,
) -> Artefact:
    """The artefact of a volume that is known.

    value: (plane, row, column), may be InParts; depth: (plane,) m; spacing: (plane, 2) m, rows and
        columns.
    opacity: like value, of opaque layers.
    """
    from plenocli.files.artefacts.container import Artefact

    data = {
        "volume/value": _single(value),
        "volume/depth": np.asarray(depth, float),
        "volume/spacing": np.asarray(spacing, float),
    }
    if opacity is not None:
        data["volume/opacity"] = opacity.astype(np.float32)
    return Artefact("volume", data, {}, provenance)


def volume_artefact(
    volume: Volume,
    depth: np.ndarray,
    spacing: np.ndarray,
    point_shape: tuple[int, int],
    provenance: Provenance,
) -> Artefact:
    """The artefact of a volume that was made from a capture.

    depth: (plane,) m; spacing: (plane, 2) m; point_shape: voxels of a lenslet.
    """
    made = truth_artefact(volume.value, depth, spacing, provenance)
    if volume.sigma is not None:
        made.data["volume/sigma"] = _single(volume.sigma)
    about: dict[str, Any] = {
        "method": volume.method,
        "trace": [[trial.what, trial.misfit] for trial in volume.trace],
        "background": volume.background,
        "margin": volume.margin,
        "point_shape": list(point_shape),
    }
    if volume.prior is not None:
        about |= {
            "correlation_length": volume.prior.correlation_length,
            "prior_variance": volume.prior.variance,
            "noise_variance": volume.prior.noise_variance,
        }
    made.attrs["volume"] = about
    if volume.likeness is not None:
        about |= {"like_factor": volume.likeness.factor, "like_share": volume.likeness.share}
    if volume.held_out is not None:
        from plenocli.inverse.volume.volume import all_known

        held = volume.held_out
        made.data |= {
            "held_out/index": held.index.astype(np.int32),
            "held_out/measured": held.measured,
            "held_out/predicted": held.predicted,
            "held_out/sigma": held.sigma,
        }
        made.attrs["held_out"] = {
            "explained_db": held.explained_db if np.isfinite(held.explained_db) else None,
            "z_rms": all_known(held.z_rms),
            "held_by_bars": all_known(held.held_by_bars),
        }
    return made


def _single(values: np.ndarray | InParts) -> np.ndarray | InParts:
    """In single precision."""
    return values if isinstance(values, InParts) else values.astype(np.float32)


def read_volume(path: Path | str, *, in_file: bool = False) -> StoredVolume:
    """The volume in a file of kind volume.

    in_file: whether a value that is not small stays in its file, of which slices of rows and
        columns are read; sigma and opacity are not wanted then.

    Raises InputError for another file.
    """
    from plenocli.files.artefacts.reading import opened_artefact, read_artefact

    if not in_file:
        return volume_of(read_artefact(path, "volume"))
    beside, value = ("volume/sigma", "volume/opacity"), "volume/value"
    with opened_artefact(path, "volume", beside, large=(value,)) as (artefact, stored):
        if value in stored:
            there = stored[value]
            artefact.data[value] = PlanesInFile(there, np.arange(there.shape[0]))
        return volume_of(artefact)


@dataclass(frozen=True)
class PlanesInFile:
    """Planes of a volume that stays in its file, by their numbers, looked at by slices (every
    plane, rows, columns). Errors as Stored.part.
    """

    stored: Stored
    numbers: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """(planes, rows, columns)."""
        return len(self.numbers), *self.stored.shape[1:]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: Any) -> Any:
        """Values of slices of all three axes; for numbers, these planes, in the file."""
        if isinstance(index, np.ndarray):
            return PlanesInFile(self.stored, self.numbers[index])
        planes, *sides = index
        return self.stored.part(EVERYTHING, *sides)[self.numbers[planes]]


def same_voxels(
    volume: StoredVolume, stack: Stack, lenslets: tuple[int, int], path: Path | str
) -> Any:
    """A volume on the voxels of kernels before `lenslets` cells: (plane, row, column), of its
    planes those that the kernels have, in its file where it was.

    Raises InputError, which names `path`, where it has other voxels.
    """
    depth, value = stack.depth, volume.value
    away = np.abs(volume.depth - depth[:, None])
    nearest = away.argmin(axis=1)
    rows, columns = (n * s for n, s in zip(lenslets, stack.point_shape))
    close = SAME * (np.ptp(depth) + stack.spacing.min())
    if value.shape[1:] != (rows, columns) or away[range(len(depth)), nearest].max() > close:
        raise InputError(
            f"a volume of {len(value)} planes of {value.shape[1]} x {value.shape[2]} voxels is not "
            f"on those of the kernels, {len(depth)} planes of {rows} x {columns}",
            path,
            "name one that was made with kernels of the same planes and points",
        )
    same_size = np.allclose(volume.spacing, stack.spacing.mean(axis=0), rtol=SAME)
    if len(value) == len(depth) and not same_size:
        raise InputError("its voxels are of another size than those of the kernels", path)
    return value[nearest]


def volume_of(artefact: Artefact) -> StoredVolume:
    """What an artefact of kind volume holds."""
    rows, columns = artefact.data["volume/spacing"].mean(axis=0).tolist()
    held = artefact.attrs.get("held_out", {})
    return StoredVolume(
        value=artefact.data["volume/value"],
        sigma=artefact.data.get("volume/sigma"),
        opacity=artefact.data.get("volume/opacity"),
        depth=artefact.data["volume/depth"],
        spacing=(rows, columns),
        facts=artefact.attrs.get("volume", {})
        | {f"held_out.{name}": value for name, value in held.items()},
    )


def score_stored(volume: StoredVolume, truth: np.ndarray) -> VolumeScore:
    """Figures of a volume against a known one, (plane, row, column), without its border.

    Raises InputError where they differ in size or are the same everywhere.
    """
    if volume.value.shape != truth.shape:
        return score_volume(volume.value, truth, (1.0, 1.0, 1.0))
    rows, columns = volume.border
    size = truth.shape
    inner = (
        slice(None),
        slice(rows, size[1] - rows) if 2 * rows < size[1] else slice(None),
        slice(columns, size[2] - columns) if 2 * columns < size[2] else slice(None),
    )
    return score_volume(
        volume.value[inner],
        truth[inner],
        (volume.step, *volume.spacing),
        sigma=None if volume.sigma is None else volume.sigma[inner],
        held_out_db=volume.facts.get("held_out.explained_db"),
        held_out_coverage=volume.facts.get("held_out.held_by_bars"),
    )
