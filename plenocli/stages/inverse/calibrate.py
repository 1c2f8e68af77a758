"""calibrate: lenslet grid, white, dark and response F of a camera from its captures."""

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import InputError, NumericsError, UsageError
from plenocli.base.progress import bar, note
from plenocli.files.read.mosaics import check_exposure_times, read_exposures, true_centres


@dataclass(frozen=True)
class Noise:
    """gain: units per electron (None: unknown);
    read_variance: of one dark pixel, units^2;
    source: where they come from.
    """

    gain: float | None
    read_variance: float | None
    source: str

    def filled(self):
        """With the rounding's variance where nothing else is known, and the source of an unknown
        gain said to be unknown.
        """
        return Noise(
            self.gain,
            1 / 12 if self.read_variance is None else self.read_variance,
            "unknown" if self.gain is None else self.source,
        )


def run_calibrate(
    output,
    *,
    whites,
    darks=(),
    bands=(),
    radiances=(),
    camera=None,
    response="auto",
    lattice="auto",
    cfa=None,
    near=None,
    overwrite=False,
    command="",
):
    """Calibrate and write `output`; returns a summary dict.

    whites, darks: paths.
    bands: (wavelength m, path) pairs, several a band allowed.
    radiances: (wavelength m, relative radiance of that source) pairs, 1 where not given.
    camera: TOML for gain and read noise.
    response: own, shared, low-rank or auto (plenocli.inverse.spectra.measured_response.decide).
    cfa: colour filter array of PNG and TIFF mosaics (default: the camera's, else mono).
    near: (row, column) px close to any superpixel's centre (see find_grid). Errors: InputError for
        files, NumericsError where there is no lattice or no light.
    """
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import camera_files, read_camera
    from plenocli.forward.sensor.frames import make_dark, merge

    bands = sorted(bands, key=lambda pair: pair[0])
    if unknown := [w for w, _ in radiances if not any(abs(w - band) < 1e-12 for band, _ in bands)]:
        raise UsageError(
            f"--band-radiance names {unknown[0] * 1e9:g} nm, of which there is no --band"
        )
    roles = {"white": list(whites), "dark": list(darks), "camera": camera, **_band_roles(bands)}
    check_output(
        output,
        overwrite=overwrite,
        inputs=[*whites, *darks, camera, *(path for _, path in bands)],
        suffixes=(".h5",),
    )
    description = read_camera(camera) if camera else None
    roles |= camera_files(camera, description) if camera else {}
    cfa = cfa or (description.sensor.cfa if description else None)
    white = read_exposures(whites, cfa=cfa)
    dark_frames = read_exposures(darks, white[0], cfa)
    check_exposure_times(white)
    reference = white[0].seconds
    dark = make_dark(
        [e.values for e in dark_frames],
        [e.seconds for e in dark_frames],
        white[0].black,
        white[0].values.shape,
    )
    del dark_frames
    noise = _told_by(white, dark, _noise(white, dark, description))

    signal, _ = merge(
        [e.values for e in white], [e.seconds for e in white], dark, white[0].white, reference
    )
    if np.isnan(signal).mean() > 0.05:
        raise InputError(
            f"{np.isnan(signal).mean():.0%} of the white image is saturated",
            white[0].path,
            "expose it for less time",
        )
    grid = _grid(signal, white[0], lattice, near)
    data, attrs = _describe_grid(grid, _window(grid), white[0].values.shape)
    bad = _bad(signal, dark, white[0])
    data |= _white(signal, bad, data)
    data["dark/mean"] = dark.mean.astype(np.float32)
    del signal
    if bands:
        noise = _response(
            data, attrs, bands, dict(radiances), white, dark, bad, noise, response, grid
        )
    noise = noise.filled()
    _add_attrs(attrs, white[0], dark, noise, reference)
    report = _report(grid, attrs, data, whites, noise)
    write_artefact(
        output,
        Artefact(
            "calibration",
            data,
            attrs,
            Provenance(
                command, describe_inputs(roles), None, to_toml(description) if description else ""
            ),
        ),
        overwrite=overwrite,
    )
    return report | {"output": str(output)}


def _band_roles(bands):
    roles = {}
    for wavelength, path in bands:
        roles.setdefault(f"band {wavelength * 1e9:.6g}nm", []).append(path)
    return roles


def _noise(white, dark, camera):
    """Gain and read variance as far as the camera description or the files say them."""
    if camera is not None and white[0].units == "DN":
        return Noise(
            camera.sensor.gain,
            (camera.sensor.gain * camera.sensor.read_noise) ** 2 + 1 / 12,
            "camera",
        )
    if white[0].sigma is not None:
        return Noise(0.0, white[0].sigma ** 2, "white noise of the simulation")
    return Noise(white[0].gain, None if dark.sigma is None else dark.sigma**2, "file")


def _told_by(group, dark, noise):
    """The noise, what is not known of it from two frames of one scene among the
    exposures `group`.
    """
    from plenocli.forward.sensor.frames import photon_transfer

    for a, b in zip(group[::2], group[1::2]):
        if (
            (noise.gain is None or noise.read_variance is None)
            and a.seconds == b.seconds
            and a.path != b.path
        ):
            limit = 0.9 * (a.white - np.mean(a.black)) if np.isfinite(a.white) else np.inf
            found = photon_transfer(
                a.values - dark.at(a.seconds), b.values - dark.at(b.seconds), limit
            )
            if found:
                return Noise(
                    found.gain if noise.gain is None else noise.gain,
                    found.read_variance if noise.read_variance is None else noise.read_variance,
                    "photon transfer of repeated frames",
                )
    return noise


def _grid(signal, white, lattice, near):
    from plenocli.inverse.grid.detect import find_grid

    try:
        return find_grid(
            np.where(np.isnan(signal), np.nanmax(signal), signal), white.cfa, None, lattice, near
        )
    except (NumericsError, InputError) as error:
        raise error.at(white.path) from None


def _window(grid):
    """Rows and columns of a superpixel window: the pitch, whole; a hexagonal
    cell's bounding square.
    """
    size = (
        np.abs(np.array([grid.basis[0, 0], grid.basis[1, 1]]))
        if grid.kind == "square"
        else np.full(2, grid.pitch.max())
    )
    return tuple(int(n) for n in (np.rint(size) if grid.kind == "square" else np.ceil(size)))


def _describe_grid(grid, window, shape):
    from plenocli.forward.sensor.superpixel import inside, windows

    origin = windows(grid.centres, window)
    valid = grid.valid & inside(origin, window, shape)
    if not valid.any():
        raise NumericsError(
            "no lenslet lies wholly on the sensor", fix="use a larger part of the sensor"
        )
    data = {
        "grid/centre": grid.centres,
        "grid/valid": valid,
        "grid/residual": grid.residual,
        "response/origin": origin,
        "response/window": np.array(window),
    }
    attrs = {
        "grid": dict(
            lattice=grid.kind,
            pitch=[float(p) for p in grid.pitch],
            angle=grid.angle,
            rms=grid.rms,
            lenslets=int(valid.sum()),
            offset=[float(c) for c in grid.centres[0, 0]],
            model={"kind": grid.model, "vectors": grid.basis.tolist()},
        )
    }
    return data, attrs


def _bad(signal, dark, white):
    from plenocli.forward.sensor.frames import bad_pixels

    return bad_pixels(signal, dark, white.white, 1 if white.cfa == "mono" else 2) | np.isnan(signal)


def _white(signal, bad, data):
    """White reference by superpixel, its level (98th percentile) and the flat field:
    white over that level.
    """
    from plenocli.forward.sensor.superpixel import extract

    origin, window, valid = (
        data["response/origin"],
        tuple(data["response/window"]),
        data["grid/valid"],
    )
    clean = np.where(bad, np.float32(np.nan), signal)
    cells = extract(clean, origin, window)
    cells[~valid] = np.nan
    level = np.full(valid.shape, np.nan, np.float32)
    level[valid] = np.nanpercentile(cells[valid], 98, axis=-1)
    if not (level[valid] > 0).all():
        valid &= level > 0
    flat = np.full(signal.shape, np.nan, np.float32)
    for (row, column), peak in zip(origin[valid], level[valid]):
        part = (slice(row, row + window[0]), slice(column, column + window[1]))
        flat[part] = clean[part] / peak
    return {"white/flat": flat, "white/level": level, "response/white": cells}


def _response(data, attrs, bands, radiances, white, dark, bad, noise, asked, grid):
    """Fill in F-hat: each band's signal over the radiance of its source, with its variance
    (pixel, band); the noise, as the captures tell it.
    """
    from plenocli.forward.sensor.frames import merge
    from plenocli.inverse.spectra.measured_response import Gathered, conditions, decide, mean

    wavelengths = list(dict.fromkeys(w for w, _ in bands))
    reference, cfa = white[0].seconds, white[0].cfa
    gathered = Gathered(
        data["response/origin"],
        tuple(data["response/window"]),
        data["grid/valid"],
        len(wavelengths),
    )
    for k, wavelength in enumerate(bar(wavelengths, len(wavelengths), "bands")):
        group = read_exposures([path for w, path in bands if w == wavelength], white[0], cfa)
        check_exposure_times([white[0], *group])
        noise = _told_by(group, dark, noise)
        share = np.mean(
            [
                1.0 if e.seconds is None or reference is None else e.seconds / reference
                for e in group
            ]
        )
        signal, weight = merge(
            [e.values for e in group], [e.seconds for e in group], dark, group[0].white, reference
        )
        signal[bad] = np.nan
        gathered.add(
            k,
            wavelength,
            signal,
            weight,
            share,
            next((r for w, r in radiances.items() if abs(w - wavelength) < 1e-12), 1.0),
        )
    known = noise.filled()
    variance = (
        None
        if known.gain is None
        else gathered.variance(known.gain, known.read_variance, dark.variance)
    )
    response, variance, record = decide(
        asked, gathered, variance, (grid.centres - gathered.origin)[gathered.valid], cfa
    )
    if response.ndim == 2:
        data["response/white"] = mean(data["response/white"][gathered.valid])
    data |= {
        "response/F": response,
        "response/wavelength": np.array(wavelengths),
        "response/energy": gathered.energy,
    }
    if variance is not None:
        data["response/covariance"] = variance
    attrs["response"] = conditions(response, variance, gathered.valid, record)
    return noise


def _add_attrs(attrs, white, dark, noise, reference):
    levels = dict(cfa=white.cfa, black=[float(b) for b in white.black.ravel()])
    if np.isfinite(white.white):
        levels["white"] = white.white
    sensor = dict(read_noise=float(np.sqrt(noise.read_variance)))
    if noise.gain:
        sensor["gain_e_per_dn"] = 1 / noise.gain
    attrs["white"] = levels | sensor | dict(notes=f"noise from: {noise.source}")
    attrs["dark"] = {}
    if reference is not None:
        attrs["white"]["exposure"] = reference
    if dark.exposure is not None:
        attrs["dark"]["exposure"] = dark.exposure
    if dark.sigma is not None:
        attrs["dark"]["sigma"] = dark.sigma
    if "response" in attrs:
        attrs["response"] |= sensor | dict(cfa=white.cfa, units=white.units)
        if reference is not None:
            attrs["response"]["exposure_s"] = reference


def _report(grid, attrs, data, whites, noise):
    worst = np.unravel_index(
        np.nanargmax(np.where(grid.valid, grid.residual, np.nan)), grid.valid.shape
    )
    report = dict(
        lattice=grid.kind,
        pitch_px=[float(p) for p in grid.pitch],
        angle_deg=grid.angle,
        rms_px=grid.rms,
        model=grid.model,
        residual_median_px=float(np.nanmedian(grid.residual[grid.valid])),
        residual_worst_px=float(grid.residual[worst]),
        residual_worst_lenslet=[int(n) for n in worst],
        lenslets=int(data["grid/valid"].sum()),
        array=list(data["grid/valid"].shape),
        window=[int(n) for n in data["response/window"]],
        noise=noise.source,
        gain_dn_per_e=noise.gain,
    )
    if "response" in attrs:
        report |= dict(
            bands_nm=[float(w * 1e9) for w in data["response/wavelength"]],
            condition=attrs["response"]["condition"],
            columns=attrs["response"]["notes"]["text"],
            response=attrs["response"]["notes"]["response"],
            angles_deg=attrs["response"]["angles"],
            bias=attrs["response"].get("bias"),
        )
    truth = true_centres(whites[0])
    if truth is not None:
        from scipy.spatial import cKDTree

        miss, _ = cKDTree(truth.reshape(-1, 2)).query(data["grid/centre"][data["grid/valid"]])
        report["deviation_px"] = float(np.sqrt(np.mean(miss**2)))
        note(
            "the simulated capture knows its centres: found within "
            f"{report['deviation_px']:.4f} px rms"
        )
    return report
