"""Results of the inverse stages from their files: pictures, spectra, dictionaries, responses and
planes.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by
from plenocli.base.tiling import Plane
from plenocli.evaluation.response_score import ComparedResponse
from plenocli.evaluation.results import Result, ToldFigures, WhiteTarget
from plenocli.files.results.lightfields import lightfield_of
from plenocli.files.results.volumes import StoredVolume, volume_of
from plenocli.inverse.lightfield.planes import LightField

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.reading import Stored

PICTURES = ("image", "spectra", "dictionary")
SCORED = (*PICTURES, "calibration", "lightfield", "volume")
"""Kinds of artefacts that score compares."""
_HISTORY = "dictionary/history/"


def read_scored(path: Path | str) -> Result | ComparedResponse | LightField | StoredVolume:
    """What score compares, from an artefact .h5 or an EXR picture.

    Raises InputError for anything else.
    """
    path = Path(path)
    if path.suffix != ".h5":
        return read_result(path, SCORED)
    artefact = _opened(path, SCORED)
    if artefact.kind == "calibration":
        return _response_of(artefact, path)
    if artefact.kind == "volume":
        return volume_of(artefact)
    return lightfield_of(artefact) if artefact.kind == "lightfield" else result_of(artefact, path)


def read_response(path: Path | str) -> ComparedResponse:
    """The response F of a calibration.

    Raises InputError where it holds none.
    """
    from plenocli.files.artefacts.reading import read_artefact

    return _response_of(read_artefact(path, "calibration"), Path(path))


def _response_of(artefact: "Artefact", path: Path) -> ComparedResponse:
    from plenocli.files.read.calibrations import calibration_of

    calibration = calibration_of(artefact)
    response, windows = calibration.response, calibration.windows
    if response is None or windows is None:
        raise InputError(
            "holds no response F, only the lenslet grid", path, "calibrate with --band captures"
        )
    return ComparedResponse(
        path=path,
        matrix=response.matrix,
        wavelengths=response.wavelengths,
        window=windows.shape,
        valid=calibration.grid.valid,
    )


def read_result(path: Path | str, kinds: tuple[str, ...] = PICTURES) -> Result:
    """A picture, spectra or a dictionary from an artefact .h5 or an EXR picture.

    kinds: that will do.

    Raises InputError for anything else.
    """
    path = Path(path)
    if path.suffix == ".h5":
        return result_of(_opened(path, kinds), path)
    if path.suffix.lower() != ".exr":
        raise InputError(
            f"is {path.suffix or 'a file without a suffix'}, not a result",
            path,
            "give an image, spectra or dictionary as .h5, or an .exr",
        )
    found = _from_exr(path)
    if found.kind not in kinds:
        raise InputError(
            f"is a picture without wavelengths where {' or '.join(kinds)} are due",
            path,
            "give a spectral EXR or an .h5 (from demux)",
        )
    return found


def _opened(path: Path, kinds: tuple[str, ...]) -> "Artefact":
    """The artefact at a path, verified; the values of a picture are Stored."""
    from plenocli.files.artefacts.reading import opened_artefact

    with opened_artefact(path, kinds, ("image/value", "image/sigma")) as (artefact, stored):
        return replace(artefact, data={**artefact.data, **stored})


def result_of(artefact: "Artefact", path: Path | str) -> Result:
    """The Result that an image, spectra or dictionary artefact holds; `path`: its file."""
    kind, data = artefact.kind, artefact.data
    attrs = artefact.attrs.get(kind, {})
    method = str(attrs.get("method", ""))
    if kind == "dictionary":
        shape = attrs.get("object_shape")
        return Result(
            path=Path(path),
            kind=kind,
            plane=Plane.of(data["dictionary/atoms"]),
            method=method,
            scale=float(attrs.get("scale") or 1.0),
            object_shape=None if shape is None else tuple(int(n) for n in shape),
            history={
                key.removeprefix(_HISTORY): values
                for key, values in data.items()
                if key.startswith(_HISTORY)
            },
        )
    plane = _plane(data[f"{kind}/value"], kind)
    return Result(
        path=Path(path),
        kind=kind,
        plane=plane,
        wavelengths=data.get(f"{kind}/wavelength") if len(plane.shape) == 3 else None,
        deviation=_plane(sigma, kind) if (sigma := data.get(f"{kind}/sigma")) is not None else None,
        s1=data.get("spectra/s1"),
        quantity=str(attrs.get("quantity", "")),
        method=method,
        block=_block(attrs.get("notes")),
        told=_told(attrs.get("parameters")),
        seen=data.get("image/seen"),
        rgb=data.get("image/rgb"),
    )


def _plane(values: "np.ndarray | Stored", kind: str) -> Plane:
    """Of what an artefact holds, or of what stays in its file; one band of a picture has no axis of
    its own.
    """
    if isinstance(values, np.ndarray):
        plane = Plane.of(values)
    else:
        plane = Plane(values.shape, values.window)
    if kind != "image" or len(plane.shape) != 3 or plane.shape[0] != 1:
        return plane
    return Plane(plane.shape[1:], lambda rows, columns: plane.read(rows, columns)[0])


def _block(notes: Any) -> tuple[int, int] | None:
    if isinstance(notes, dict) and len(notes.get("block") or ()) == 2:
        rows, columns = (int(n) for n in notes.get("block", ()))
        return rows, columns
    return None


def _told(parameters: Any) -> ToldFigures:
    parameters = parameters if isinstance(parameters, dict) else {}
    limits, seen = parameters.get("limits") or {}, parameters.get("seen") or {}
    return ToldFigures(
        noise_relative=limits.get("noise"),
        model_error_relative=limits.get("model_error"),
        limited_by=limits.get("limited_by"),
        noise_raised=parameters.get("noise_raised"),
        detail_kept=parameters.get("detail_kept"),
        seen_share=seen.get("share"),
    )


def _from_exr(path: Path) -> Result:
    from plenocli.files.images.exr import read_exr, read_header, stored_channel
    from plenocli.files.images.spectral_exr import is_spectral, read_spectral_exr

    if is_spectral(path):
        spectral = read_spectral_exr(path)
        return Result(
            path=path,
            kind="spectra",
            plane=Plane.of(spectral.values),
            wavelengths=np.asarray(spectral.wavelengths),
            deviation=None if spectral.sigma is None else Plane.of(spectral.sigma),
            quantity=spectral.quantity,
            method=str(spectral.attrs.get("method", "")),
        )
    header = read_header(path)
    if header.by_lines and len(header.names) == 1:
        return Result(
            path=path,
            kind="image",
            plane=stored_channel(path, header, header.names[0]),
            method=str(header.attrs.get("method", "")),
        )
    channels, attrs = read_exr(path)
    if "Y" not in channels and len(channels) != 1:
        raise InputError(
            f"has the channels {', '.join(channels)} and no wavelengths",
            path,
            "give a picture with channel Y, or a spectral EXR",
        )
    values = channels.get("Y", next(iter(channels.values())))
    colour = [channels[name] for name in "RGB" if name in channels]
    return Result(
        path=path,
        kind="image",
        plane=Plane.of(values),
        method=str(attrs.get("method", "")),
        rgb=np.stack(colour) if len(colour) == 3 else None,
    )


def read_block(result: Result, truth: Path | str | None) -> tuple[int, int] | None:
    """Object samples under one lenslet (rows, columns) as the files tell it, or None.

    truth: a capture says it by the number of its lenslets, where the result does not.
    """
    if result.block is not None:
        return result.block
    if truth is not None and Path(truth).suffix == ".h5":
        from plenocli.files.results.truths import opened_truth

        attrs = opened_truth(truth).attrs.get("capture", {})
        count = [int(n) for n in np.ravel(attrs.get("lenslet_count", ()))]
        if count and all(n % c == 0 for n, c in zip(result.grid, count, strict=True)):
            rows, columns = (n // c for n, c in zip(result.grid, count, strict=True))
            return rows, columns
    return None


def read_whites(paths: Iterable[Path | str]) -> dict[str, WhiteTarget]:
    """Spectra of white targets by the method that made them.

    Raises InputError for a file that is none, UsageError where those of a method do not fit each
    other.
    """
    groups: dict[str, list[Result]] = {}
    for path in paths:
        frame = read_result(path, ("spectra",))
        group = groups.setdefault(frame.method, [])
        if group and frame.values.shape != group[0].values.shape:
            raise UsageError(
                f"has {by(frame.values.shape)} values (band x row x column), {group[0].name} "
                f"{by(group[0].values.shape)}",
                path,
                "give white targets demultiplexed with one calibration",
            )
        group.append(frame)
    return {
        method: WhiteTarget(np.array([frame.values for frame in group]), group[0].sigma)
        for method, group in groups.items()
    }
