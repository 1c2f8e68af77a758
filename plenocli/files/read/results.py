"""What score compares: results, truths and label maps from their files, brought to one grid."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by

CHART = "colorchecker"
# chart samples per lenslet and side when the truth of a mixed lenslet is averaged
_CHART_OVERSAMPLING = 20


@dataclass
class Result:
    """values: (row, column) or (band, row, column) float64;
    wavelengths (band,) m or None;
    quantity "" for pictures.

    kind: "image", "spectra", "dictionary" (values are then the atoms), "calibration" (the response
        as stored) or "lightfield" (planes).
    sigma: like values, or None.
    """

    name: str
    kind: str
    values: np.ndarray
    wavelengths: np.ndarray | None = None
    sigma: np.ndarray | None = None
    quantity: str = ""
    attrs: dict = field(default_factory=dict)

    @property
    def method(self):
        return str(self.attrs.get("method", ""))

    @property
    def grid(self):
        return self.values.shape[-2:]


def read_result(path, kinds=("image", "spectra", "dictionary")):
    """A result from an artefact .h5 or an EXR picture (spectral or not).

    InputError for anything else.
    """
    path = Path(path)
    if path.suffix == ".h5":
        return _from_artefact(path, kinds)
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


def _from_artefact(path, kinds):
    from plenocli.files.artefacts.container import read_artefact

    artefact = read_artefact(path, kinds)
    attrs = artefact.attrs.get(artefact.kind, {})
    if artefact.kind == "dictionary":
        return Result(path.stem, "dictionary", artefact.data["dictionary/atoms"], attrs=attrs)
    if artefact.kind == "calibration":
        return Result(path.stem, "calibration", artefact.data.get("response/F"), attrs=attrs)
    if artefact.kind == "lightfield":
        return Result(path.stem, "lightfield", artefact.data["refocus/value"], attrs=attrs)
    kind = artefact.kind
    data = {part: artefact.data.get(f"{kind}/{part}") for part in ("value", "sigma", "wavelength")}
    values = np.asarray(data["value"], dtype=np.float64)
    if kind == "image" and values.ndim == 3 and len(values) == 1:
        values = values[0]
    return Result(
        path.stem,
        kind,
        values,
        data["wavelength"] if values.ndim == 3 else None,
        data["sigma"],
        str(attrs.get("quantity", "")),
        attrs,
    )


def _from_exr(path):
    from plenocli.files.images.exr import read_exr
    from plenocli.files.images.spectral_exr import is_spectral, read_spectral_exr

    if is_spectral(path):
        spectral = read_spectral_exr(path)
        values = np.asarray(spectral.values, dtype=np.float64)
        return Result(
            path.stem,
            "spectra",
            values,
            np.asarray(spectral.wavelengths),
            spectral.sigma,
            spectral.quantity,
            dict(spectral.attrs),
        )
    channels, attrs = read_exr(path)
    if "Y" not in channels and len(channels) != 1:
        raise InputError(
            f"has the channels {', '.join(channels)} and no wavelengths",
            path,
            "give a picture with channel Y, or a spectral EXR",
        )
    values = channels.get("Y", next(iter(channels.values())))
    return Result(path.stem, "image", np.asarray(values, dtype=np.float64), attrs=dict(attrs))


def read_truth(truth, result, sampling="fit", camera=None):
    """The truth on the grid and at the wavelengths of `result`: an array like result.values.

    truth: a path or a name that stages.scenes.read_scene knows. A capture brings the object that it
        was simulated from; a finer grid is averaged over areas; other wavelengths are interpolated.
    camera: a Camera through whose filters a scene is seen (width, leak, light and all), instead
        of at their centres.
    InputError where no comparison is possible.
    """
    rows, cols = result.grid
    spectral = result.wavelengths is not None
    known = (
        None
        if camera is not None and Path(truth).suffix == ".h5" and _is_scene(truth)
        else _known_truth(truth)
    )
    if known is not None and camera is not None:
        raise InputError(
            "is known at some wavelengths only and cannot be seen through filters",
            truth,
            "name the scene itself: an image with wavelengths, a spectral EXR or colorchecker",
        )
    if known is None:
        from plenocli.files.read.scenes import Chart, read_scene

        scene = read_scene(truth, sampling=sampling, spectral=spectral)
        if not spectral and getattr(scene, "spectral", False):
            raise InputError(
                "is spectral, the result is a single picture",
                truth,
                "compare with a photograph or with the capture's own scene",
            )
        fine = _CHART_OVERSAMPLING if isinstance(scene, Chart) else 1
        plane = lambda w: _coarser(scene.at(w, rows * fine, cols * fine), rows, cols)
        if spectral and camera is not None:
            return _through_filters(plane, camera, result.wavelengths)
        planes = [plane(w) for w in (result.wavelengths if spectral else [550e-9])]
        return np.array(planes) if spectral else planes[0]
    values, wavelengths = known
    if not spectral and len(values) != 1:
        raise InputError(
            f"has {len(values)} bands, the result has one and does not say which",
            truth,
            "compare bands with a spectral result",
        )
    if spectral:
        values = _at_wavelengths(values, wavelengths, result.wavelengths, truth)
    _same_aspect(values.shape[-2:], (rows, cols), truth)
    values = np.array([_coarser(plane, rows, cols) for plane in values])
    return values if spectral else values[0]


def _is_scene(path):
    """Whether an .h5 is an image with wavelengths, which serves as a scene at any of them."""
    from plenocli.files.artefacts.container import read_artefact

    artefact = read_artefact(path, ("capture", "spectra", "image"))
    return artefact.kind == "image" and artefact.data["image/value"].ndim == 3


def _through_filters(plane, camera, bands):
    """Reflectance (band, row, column) as a camera with one filter a band sees it: mean of
    plane(wavelength), weighted with the light's photons, the filter's transmittance and the
    sensor's sensitivity (mean of its colours).
    """
    from plenocli.forward.camera.pupil import filter_transmittance
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant
    from plenocli.forward.sensor.cfa import sensitivity

    if camera.filter_array is None:
        raise UsageError(
            "has no [filter_array], through which the truth could be seen",
            "--camera",
            "leave --camera out",
        )
    filters = [
        min(camera.filter_array.filters, key=lambda f: abs(f.center - band)) for band in bands
    ]
    far = [band for band, f in zip(bands, filters, strict=True) if abs(f.center - band) > f.fwhm]
    if far:
        raise UsageError(
            f"has no filter at {far[0] * 1e9:.4g} nm, a band of the result",
            "--camera",
            "name the camera that the result was made with",
        )
    light = broadband(camera, lambda wavelengths: illuminant(camera.light.illuminant, wavelengths))
    seen = sensitivity(camera, light.wavelengths)[1].mean(axis=0)
    weights = np.array(
        [
            [
                n * q * filter_transmittance(f, w)
                for w, n, q in zip(light.wavelengths, light.photons, seen, strict=True)
            ]
            for f in filters
        ]
    )
    total = 0.0
    for weight, wavelength in zip(weights.T, light.wavelengths, strict=True):
        total = total + weight[:, None, None] * plane(wavelength)
    return total / weights.sum(axis=1)[:, None, None]


def _known_truth(truth):
    """(values (band, row, column), wavelengths or None) of a capture or spectra artefact; None
    for everything else.
    """
    path = Path(truth)
    if path.suffix != ".h5":
        return None
    from plenocli.files.artefacts.container import read_artefact

    artefact = read_artefact(path, ("capture", "spectra", "image"))
    if artefact.kind == "spectra":
        return np.asarray(artefact.data["spectra/value"], dtype=np.float64), artefact.data[
            "spectra/wavelength"
        ]
    if artefact.kind == "image":
        values = np.asarray(artefact.data["image/value"], dtype=np.float64)
        return (values if values.ndim == 3 else values[None]), artefact.data.get("image/wavelength")
    if "capture/scene" not in artefact.data:
        raise InputError(
            "holds no scene: it was measured, or simulated without one",
            path,
            "name the truth itself with --truth",
        )
    return np.asarray(artefact.data["capture/scene"], dtype=np.float64), artefact.data.get(
        "capture/wavelength"
    )


def _at_wavelengths(values, own, asked, where):
    if own is None:
        if len(values) == len(asked):
            return values
        raise InputError(
            f"has {len(values)} bands of unknown wavelength, the result has {len(asked)}",
            where,
            "give a truth that names its wavelengths",
        )
    if len(own) == 1 or asked.min() < own[0] - 1e-8 or asked.max() > own[-1] + 1e-8:
        if len(own) != len(asked) or np.abs(np.asarray(own) - asked).max() > 1e-9:
            raise InputError(
                (
                    f"covers {own[0] * 1e9:.4g} to {own[-1] * 1e9:.4g} nm, the result "
                    f"{asked.min() * 1e9:.4g} to {asked.max() * 1e9:.4g} nm"
                ),
                where,
                "give a truth that covers the bands of the result",
            )
    position = np.interp(asked, own, np.arange(len(own)))
    low = np.minimum(position.astype(int), max(len(own) - 2, 0))
    part = (position - low)[:, None, None]
    high = np.minimum(low + 1, len(own) - 1)
    return (1 - part) * values[low] + part * values[high]


def _same_aspect(have, want, where):
    if have[0] * want[1] != have[1] * want[0] or have[0] < want[0]:
        raise InputError(
            f"is {have[0]} x {have[1]} samples, the result {want[0]} x {want[1]} (rows x columns)",
            where,
            "give the truth of the same object on the same or a finer grid",
        )


def _coarser(plane, rows, cols):
    """A plane averaged over areas to (rows, cols), float64; itself where it has that shape."""
    from plenocli.forward.scene.sample import area_average

    plane = np.asarray(plane, dtype=np.float64)
    return (
        plane
        if plane.shape == (rows, cols)
        else area_average(area_average(plane, rows, 0), cols, 1)
    )


def read_labels(source, grid):
    """Label map (row, column) int on the lenslet grid: 0 nothing, 1..24 the ColorChecker's
    patches row by row.

    source: "colorchecker" for the chart as capture-sim lays it out, or a single-channel
        .png/.tif/.exr on this grid or one finer by a whole number, where only lenslets that see one
        label alone keep it.
    """
    from plenocli.base.tiling import to_blocks
    from plenocli.forward.scene.chart import chart_labels

    rows, cols = grid
    if str(source) == CHART:
        return chart_labels(rows, cols, whole_cells=True).astype(int)
    from plenocli.files.images.mosaic import read_capture

    values = np.asarray(read_capture(source).mosaic)
    if values.ndim != 2 or values.shape[0] % rows or values.shape[1] % cols:
        raise InputError(
            f"is {' x '.join(map(str, values.shape))}, the result has {rows} x {cols} lenslets",
            source,
            "give one channel on the lenslet grid, or finer by a whole number",
        )
    labels = np.rint(values).astype(int)
    if np.abs(labels - values).max() > 1e-3 or labels.min() < 0 or labels.max() > 24:
        raise InputError(
            "holds values that are no labels",
            source,
            "use 0 for nothing and 1 to 24 for the patches",
        )
    blocks = to_blocks(labels, (values.shape[0] // rows, values.shape[1] // cols))
    return np.where((blocks == blocks[..., :1]).all(-1), blocks[..., 0], 0)


def block_of(result, truth, pif=None):
    """Object samples under one lenslet (h, w) as the files tell it, or None: from the result,
    the truth or the matrix.
    """
    notes = result.attrs.get("notes")
    if isinstance(notes, dict) and len(notes.get("block") or ()) == 2:
        return tuple(int(n) for n in notes["block"])
    if pif is not None:
        return tuple(int(n) for n in pif.data["pif/object_shape"])
    if truth is not None and Path(truth).suffix == ".h5":
        from plenocli.files.artefacts.container import read_artefact

        attrs = read_artefact(truth, ("capture", "spectra", "image")).attrs.get("capture", {})
        if "lenslet_count" in attrs:
            count = [int(n) for n in np.ravel(attrs["lenslet_count"])]
            if all(n % c == 0 for n, c in zip(result.grid, count, strict=True)):
                return tuple(n // c for n, c in zip(result.grid, count, strict=True))
    return None


def read_whites(paths):
    """Spectra of white targets by method: dict method -> (values (frame, band, row, column),
    sigma of the first or None).
    """
    groups = {}
    for path in paths:
        frame = read_result(path, ("spectra",))
        group = groups.setdefault(frame.method, [])
        if group and frame.values.shape != group[0].values.shape:
            raise UsageError(
                (
                    f"has {by(frame.values.shape)} values (band x row x column), {group[0].name} "
                    f"{by(group[0].values.shape)}"
                ),
                path,
                "give white targets demultiplexed with one calibration",
            )
        group.append(frame)
    return {
        method: (np.array([frame.values for frame in group]), group[0].sigma)
        for method, group in groups.items()
    }
