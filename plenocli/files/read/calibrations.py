"""Calibration files: the one place that knows their datasets and attributes, read and written."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.kinds import scale_problem
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import Stored, opened_artefact, read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.cameras import described_camera
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import (
    Calibration,
    Quality,
    Response,
    Sensor,
    White,
    Windows,
)
from plenocli.inverse.grid.lenslet_grid import LensletGrid

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

Datasets = dict[str, np.ndarray]
Attributes = dict[str, Any]

PARTS = {
    "response": ("response/F", "response/wavelength"),
    "windows": ("response/origin", "response/window"),
    "white": ("response/white",),
    "dark": ("dark/mean",),
}
"""Datasets that a file must have to hold a part."""
WHITE_IMAGE = ("white/flat", "white/level")
"""The white image, which is large and which those do not need who have its superpixels."""
IMAGES = {"white/flat", "dark/mean"}
"""Datasets with a value for every pixel of the sensor."""
LARGE = {"response/F", "response/white", "dark/mean"}
"""Datasets that may stay in the file."""
UNREAD = tuple(f"response/{name}" for name in ("F", "covariance", "polarised", "energy"))
"""Of a response, which those do not need who have the superpixels of white."""


def read_calibration(
    path: str | Path,
    *,
    needs: tuple[str, ...] = (),
    response: bool = True,
    white_image: bool = True,
) -> Calibration:
    """The Calibration of an artefact.

    needs: parts (of PARTS) that it must hold.
    response: whether the response is wanted; without it the sensor's levels are those of the white
        image.
    white_image: whether the white image is wanted; without it White has its superpixels alone.

    Raises InputError where the file cannot be read or lacks what is needed.
    """
    return calibration_of(_read(path, needs, white_image), response=response)


def read_images(path: str | Path, *, small: bool = False, superpixels: bool = False) -> Calibration:
    """A Calibration with its lenslets, and the white and the dark image, which stay in the file;
    without responses.

    small: whether what is small beside the memory is held.
    superpixels: whether those of white are wanted; they stay there as well.

    Raises InputError where the file cannot be read.
    """
    wanted = IMAGES | ({"response/white"} if superpixels else set())
    unread = [*UNREAD, *([] if superpixels else ["response/white"])]
    apart, large = (unread, wanted) if small else ([*wanted, *unread], set())
    with opened_artefact(path, "calibration", apart, large=large) as (artefact, stored):
        for name in stored.keys() & wanted:
            values = stored[name]
            kept: Any = Plane(values.shape, values.window)
            artefact.data[name] = kept if name in IMAGES else _in_file(values, told_apart=False)
    return calibration_of(artefact, response=False)


def read_white(path: str | Path, *, in_file: bool = False) -> Calibration:
    """What a calibration artefact knows of lenslets, the superpixels of white, and dark.

    in_file: whether these two stay in the file where they are not small.

    Raises InputError where the file cannot be read, or lacks one of them.
    """
    large = LARGE if in_file else ()
    with opened_artefact(path, "calibration", [*UNREAD, *WHITE_IMAGE], large=large) as found:
        artefact, stored = found
        for name in stored.keys() & LARGE - {*UNREAD}:
            artefact.data[name] = _in_file(stored[name], told_apart=False)
    return calibration_of(_sound(artefact, path, ("windows", "white", "dark")), response=False)


def read_described(
    path: str | Path, *, needs: tuple[str, ...], in_file: bool = False
) -> tuple[Calibration, Camera | None]:
    """A Calibration without its white image, and the camera as it was described to whoever made
    the file; None: it was not, or by more files than one.

    path, needs: as read_calibration's.
    in_file: whether responses, superpixels of white and the dark image stay in the file where they
        are not small.
    """
    large = LARGE if in_file else ()
    with opened_artefact(path, "calibration", WHITE_IMAGE, large=large) as (artefact, stored):
        for name in stored.keys() & LARGE:
            artefact.data[name] = _in_file(stored[name], "response/polarised" in artefact.data)
    return calibration_of(_sound(artefact, path, needs)), described_camera(artefact, path)


def _in_file(values: Stored, told_apart: bool) -> Any:
    """Large values of LARGE, in memory where they are one for all lenslets.

    told_apart: whether states of polarisation are, by all of a response.
    """
    if values.name == "dark/mean":
        return Plane(values.shape, values.window)
    own = len(values.shape) > 2 and not told_apart
    return ByLenslet(values) if own else _of_scale(values, values.part())


def _of_scale(stored: Stored, values: np.ndarray) -> np.ndarray:
    """Some values of a dataset of LARGE; InputError where they are responses of no scale."""
    if stored.name == "response/F":
        known = np.isfinite(values)
        ends = values.max(initial=0, where=known), -values.min(initial=0, where=known)
        if wrong := scale_problem(float(max(ends))):
            raise InputError(wrong, stored.path, "calibrate again")
    return values


class ByLenslet:
    """Values of lenslets that stay in their file; plenocli.inverse.calibration.MadeResponses."""

    def __init__(self, stored: Stored) -> None:
        self.stored, self.shape, self.ndim = stored, stored.shape, len(stored.shape)

    def __getitem__(self, places: slice | tuple[np.ndarray, ...]) -> np.ndarray:
        if isinstance(places, slice):  # of rows
            return _of_scale(self.stored, self.stored.part(places))
        rows, columns = places
        out = np.empty((len(rows), *self.shape[2:]), self.stored.dtype)
        dense = 2 * len(rows) > math.prod(np.ptp(place) + 1 for place in places) if len(rows) else 0
        for here in [np.arange(len(rows))] if dense else [rows == row for row in np.unique(rows)]:
            sides = [slice(int(p[here].min()), int(p[here].max()) + 1) for p in places]
            near = (place[here] - side.start for place, side in zip(places, sides))
            out[here] = self.stored.part(*sides)[tuple(near)]
        return _of_scale(self.stored, out)


def _read(path: str | Path, needs: tuple[str, ...], white_image: bool) -> Artefact:
    skip = () if white_image else WHITE_IMAGE
    return _sound(read_artefact(path, "calibration", skip=skip), path, needs)


def _sound(artefact: Artefact, path: str | Path, needs: tuple[str, ...]) -> Artefact:
    """An artefact that holds what is needed; raises as read_calibration."""
    for part in needs:
        for name in PARTS[part]:
            if name not in artefact.data:
                raise _lacks(name, path)
    window, matrix = (artefact.data.get(f"response/{name}") for name in ("window", "F"))
    if window is not None and matrix is not None and np.prod(window) != matrix.shape[-2]:
        raise InputError(
            "has another number of pixels in response/F than in its windows", path, "make it again"
        )
    light = artefact.data.get("response/wavelength", np.array([5e-7]))
    if not 1e-8 < light.min() <= light.max() < 1e-3:
        raise InputError("has a response to no light: wavelengths are in metres", path, "mend it")
    return artefact


def calibration_of(artefact: Artefact, *, response: bool = True) -> Calibration:
    """The Calibration of an artefact that was read already; arguments as read_calibration's."""
    data, attrs = artefact.data, artefact.attrs
    white, dark = attrs.get("white", {}), attrs.get("dark", {})
    has = {part: all(name in data for name in PARTS[part]) for part in PARTS}
    with_response = response and has["response"]
    return Calibration(
        grid=_grid(data, attrs.get("grid", {})),
        sensor=_sensor(white, attrs.get("response", {}) if with_response else None),
        windows=Windows(data["response/origin"], _pair(data["response/window"]))
        if has["windows"]
        else None,
        white=White(data.get("response/white"), data.get("white/level"), data.get("white/flat")),
        dark=Dark(
            mean=data["dark/mean"],
            black=_black(white),
            exposure=dark.get("exposure"),
            sigma=dark.get("sigma"),
        )
        if has["dark"]
        else None,
        response=_response(data, attrs.get("response", {})) if with_response else None,
    )


def write_calibration(
    path: str | Path, calibration: Calibration, provenance: Provenance, *, overwrite: bool = False
) -> None:
    """Write a calibration, whole or not at all.

    Raises UsageError, OutputError.
    """
    c = calibration
    datasets = {
        "grid/centre": c.grid.centres,
        "grid/valid": c.grid.valid,
        "grid/residual": c.grid.residual,
        "white/flat": None if c.white is None else c.white.flat,
        "white/level": None if c.white is None else c.white.level,
        "dark/mean": None if c.dark is None else c.dark.mean.astype(np.float32, copy=False),
        "response/origin": None if c.windows is None else c.windows.origin,
        "response/window": None if c.windows is None else np.array(c.windows.shape),
        "response/white": None if c.white is None else c.white.superpixels,
    }
    attrs = {"grid": _grid_attrs(c.grid), "white": _white_attrs(c), "dark": _dark_attrs(c.dark)}
    if c.response is not None:
        datasets |= {
            "response/F": c.response.matrix,
            "response/covariance": c.response.variance,
            "response/wavelength": c.response.wavelengths,
            "response/polarised": c.response.polarised,
            "response/energy": c.response.energy,
        }
        attrs["response"] = _response_attrs(c.response, c.sensor)
    write_artefact(path, Artefact("calibration", datasets, attrs, provenance), overwrite=overwrite)


# --- reading --------------------------------------------------------------------------------------


def _lacks(name: str, path: str | Path) -> InputError:
    if name == "response/F":
        return InputError(
            "holds no response F, only the lenslet grid", path, "calibrate with --band captures"
        )
    return InputError(f"lacks {name}", path, "run calibrate again")


def _pair(values: np.ndarray) -> tuple[int, int]:
    rows, columns = (int(n) for n in values)
    return rows, columns


def _grid(data: Datasets, attrs: Attributes) -> LensletGrid:
    model = attrs.get("model")
    model = model if isinstance(model, dict) else {}
    return LensletGrid(
        lattice=str(attrs.get("lattice", "square")),
        pitch=np.array(attrs.get("pitch", [np.nan, np.nan]), float),
        angle=float(attrs.get("angle", np.nan)),
        basis=np.array(model.get("vectors", np.full((2, 2), np.nan)), float),
        model=str(model.get("kind", "")),
        centres=data["grid/centre"],
        valid=data["grid/valid"].astype(bool),
        residual=data.get("grid/residual"),
        rms=float(attrs.get("rms", np.nan)),
        expected_error=attrs.get("expected_error"),
    )


def _sensor(white: Attributes, response: Attributes | None) -> Sensor:
    """What is said beside the response holds for it, what is said beside the white image where
    there is no response.
    """
    of, exposure = (white, "exposure") if response is None else (response, "exposure_s")
    read_noise = of.get("read_noise")
    return Sensor(
        cfa=str(of.get("cfa", "mono")),
        units="DN" if response is None else str(response.get("units", "DN")),
        white_level=float(white.get("white", np.inf)),
        exposure=of.get(exposure),
        gain_e_per_dn=of.get("gain_e_per_dn"),
        read_noise=None if read_noise is None else float(read_noise),
        notes=white.get("notes"),
    )


def _black(white: Attributes) -> np.ndarray:
    """Levels of no light by position, (2, 2)."""
    black = np.asarray(white.get("black", 0.0), float)
    return black.reshape(2, 2) if black.size == 4 else np.full((2, 2), float(black.ravel()[0]))


def _response(data: Datasets, attrs: Attributes) -> Response:
    quality, notes = None, attrs.get("notes")
    if all(name in attrs for name in ("condition", "angles", "single_pixel")):
        quality = Quality(
            condition=attrs["condition"],
            angles=attrs["angles"],
            single_pixel=attrs["single_pixel"],
            bias=attrs.get("bias"),
        )
    return Response(
        matrix=data["response/F"],
        variance=data.get("response/covariance"),
        wavelengths=data["response/wavelength"],
        polarised=data.get("response/polarised"),
        energy=data.get("response/energy"),
        quality=quality,
        notes=notes if isinstance(notes, dict) else None,
    )


# --- writing --------------------------------------------------------------------------------------


def _grid_attrs(grid: LensletGrid) -> Attributes:
    return {
        "lattice": grid.lattice,
        "pitch": [float(p) for p in grid.pitch],
        "angle": grid.angle,
        "rms": grid.rms,
        "expected_error": grid.expected_error,
        "lenslets": int(grid.valid.sum()),
        "offset": [float(c) for c in grid.centres[0, 0]],
        "model": {
            "kind": grid.model,
            "vectors": [[float(v) for v in vector] for vector in grid.basis],
        },
    }


def _noise_attrs(sensor: Sensor) -> Attributes:
    return {"read_noise": sensor.read_noise, "gain_e_per_dn": sensor.gain_e_per_dn}


def _white_attrs(calibration: Calibration) -> Attributes:
    sensor, dark = calibration.sensor, calibration.dark
    return {
        "cfa": sensor.cfa,
        "black": None if dark is None else [float(b) for b in dark.black.ravel()],
        "white": float(sensor.white_level) if np.isfinite(sensor.white_level) else None,
        **_noise_attrs(sensor),
        "notes": sensor.notes,
        "exposure": sensor.exposure,
    }


def _dark_attrs(dark: Dark | None) -> Attributes:
    return {} if dark is None else {"exposure": dark.exposure, "sigma": dark.sigma}


def _response_attrs(response: Response, sensor: Sensor) -> Attributes:
    quality = response.quality
    return {
        "condition": None if quality is None else quality.condition,
        "angles": None if quality is None else quality.angles,
        "single_pixel": None if quality is None else quality.single_pixel,
        "notes": response.notes,
        "bias": None if quality is None else quality.bias,
        **_noise_attrs(sensor),
        "cfa": sensor.cfa,
        "units": sensor.units,
        "exposure_s": sensor.exposure,
    }
