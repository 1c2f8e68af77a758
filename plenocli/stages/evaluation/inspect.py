"""What a file holds, in words and numbers: every artefact, EXR, RAW, DNG, PNG, TIFF and JPEG."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.evaluation.inspection import (
    ArtefactReport,
    AttributeReport,
    BandsReport,
    ChannelsReport,
    DatasetReport,
    FileReport,
    PositionReport,
    RawReport,
    as_plain,
    statistics,
)

if TYPE_CHECKING:
    from plenocli.files.artefacts.schema import Schema


def run_inspect(path: Path | str) -> FileReport:
    """Read and verify a file, and say what it holds.

    Raises InputError for a file that a stage would refuse, with the same words.
    """
    from plenocli.files.artefacts.provenance import require_file
    from plenocli.files.images.mosaic import is_hdf5
    from plenocli.files.images.pictures import file_type

    path = Path(path)
    size, kind = require_file(path), file_type(path)
    content: ArtefactReport | ChannelsReport | RawReport
    if is_hdf5(path):
        content = _artefact(path)
    elif kind == "exr":
        content = _exr(path)
    elif kind in ("png", "jpeg") or (kind == "tiff" and path.suffix.lower() in (".tif", ".tiff")):
        content = _picture(path, kind)
    else:
        content = _raw(path)
    return FileReport(file=path.name, bytes=size, content=content)


def _unit(schema: Schema, where: str, name: str) -> str:
    attr = schema.attr_for(where, name)
    assert attr is not None  # a file with others is refused when it is read
    return attr.unit


def _artefact(path: Path) -> ArtefactReport:
    from plenocli.files.artefacts.kinds import SCHEMAS
    from plenocli.files.artefacts.reading import read_artefact

    artefact = read_artefact(path)
    schema, origin = SCHEMAS[artefact.kind], artefact.provenance
    datasets = {}
    for name, values in artefact.data.items():
        field = schema.field_for(name)
        assert field is not None  # a file with others is refused when it is read
        datasets[name] = DatasetReport(
            shape=values.shape,
            dtype=str(values.dtype),
            unit=field.unit,
            meaning=field.doc,
            statistics=statistics(values),
        )
    return ArtefactReport(
        kind=artefact.kind,
        schema_version=schema.version,
        what=schema.doc,
        command=origin.command,
        seed=origin.seed,
        inputs=origin.inputs,
        accuracy=origin.accuracy,
        config=origin.config,
        datasets=datasets,
        attributes={
            where: {
                name: AttributeReport(as_plain(value), _unit(schema, where, name))
                for name, value in named.items()
            }
            for where, named in artefact.attrs.items()
            if named
        },
    )


def _exr(path: Path) -> ChannelsReport:
    from plenocli.files.images.exr import SEALED, read_exr
    from plenocli.files.images.spectral_exr import is_spectral, read_spectral_exr

    channels, attrs = read_exr(path)
    rows, columns = next(iter(channels.values())).shape
    bands = None
    if is_spectral(path):
        spectral = read_spectral_exr(path)
        bands = BandsReport(
            quantity=spectral.quantity,
            wavelengths_m=[float(w) for w in spectral.wavelengths],
            has_sigma=spectral.sigma is not None,
        )
    return ChannelsReport(
        type="exr" if bands is None else "spectral exr",
        rows=rows,
        columns=columns,
        verified=SEALED in attrs,
        channels={name: statistics(plane) for name, plane in channels.items()},
        attributes=attrs,
        bands=bands,
    )


def _picture(path: Path, kind: str) -> ChannelsReport:
    from plenocli.files.images.pictures import read_stored
    from plenocli.files.seal import require_seal

    values, names, bits = read_stored(path, kind)
    return ChannelsReport(
        type=kind,
        rows=values.shape[0],
        columns=values.shape[1],
        verified=kind == "tiff" and require_seal(path),
        channels={name: statistics(values[..., i]) for i, name in enumerate(names)},
        bits=bits,
        dtype=str(values.dtype),
    )


def _raw(path: Path) -> RawReport:
    from plenocli.files.images.mosaic import read_capture

    capture = read_capture(path)
    values, levels, meta = capture.mosaic, capture.levels, dict(capture.metadata.details)
    meta = {name: v for name, v in meta.items() if name not in ("make", "model") or not v}
    letters = "mmmm" if capture.cfa == "mono" else capture.cfa
    positions = {
        f"{letter} ({i}, {j})": PositionReport(
            statistics(values[i::2, j::2]), float(levels.black[i, j])
        )
        for (i, j), letter in zip([(0, 0), (0, 1), (1, 0), (1, 1)], letters)
    }
    return RawReport(
        type="dng" if capture.metadata.source == "dng" else "raw",
        rows=values.shape[0],
        columns=values.shape[1],
        cfa=capture.cfa,
        black=levels.black.tolist(),
        white=levels.white,
        exposure_s=capture.exposure_s,
        iso=meta.pop("iso", None),
        f_number=meta.pop("f_number", None),
        focal_length_m=meta.pop("focal_length_m", None),
        camera=capture.metadata.camera,
        dtype=str(values.dtype),
        verified=bool(meta.pop("verified", False)),
        zeros=float(np.mean(values == 0)),
        saturated=float(np.mean(values >= levels.white)),
        positions=positions,
        meta=as_plain(meta),
    )
