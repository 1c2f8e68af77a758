"""calibrate: lenslet grid, white, dark and response F of a camera from its captures."""

from dataclasses import dataclass

import numpy as np

from plenocli.errors import InputError, NumericsError, UsageError
from plenocli.stages.mosaics import check_exposure_times, read_exposures, true_centres
from plenocli.stages.progress import note


@dataclass(frozen=True)
class Noise:
    """gain: units per electron (None: unknown); read_variance: of one dark pixel, units^2; source: where they come from."""

    gain: float | None
    read_variance: float
    source: str


def run_calibrate(output, *, whites, darks=(), bands=(), radiances=(), camera=None, shared=False, denoise=False, lattice="auto", cfa=None, near=None, overwrite=False, command=""):
    """Calibrate and write `output`; returns a summary dict.

    whites, darks: paths. bands: (wavelength m, path) pairs, several a band allowed. radiances: (wavelength m, relative
    radiance of that source) pairs, 1 where not given. camera: TOML for gain and read noise. shared: one F for all
    lenslets; denoise: take off noise by what the lenslets' responses have in common. cfa: colour filter array of PNG and TIFF mosaics (default: the camera's, else mono). near: (row, column) px close
    to any superpixel's centre (see find_grid). Errors: InputError for files, NumericsError where there is no lattice or no light.
    """
    from plenocli.artefacts import Artefact, Provenance, check_output, describe_inputs, write_artefact
    from plenocli.stages.cameras import camera_files, read_camera
    from plenocli.sensor.frames import make_dark, merge

    if denoise and shared:
        raise UsageError("--denoise and --shared exclude each other: a shared response is an average already")
    bands = sorted(bands, key=lambda pair: pair[0])
    roles = {"white": list(whites), "dark": list(darks), "camera": camera, **_band_roles(bands)}
    check_output(output, overwrite=overwrite, inputs=[*whites, *darks, camera, *(path for _, path in bands)], suffixes=(".h5",))
    description = read_camera(camera) if camera else None
    roles |= camera_files(camera, description) if camera else {}
    cfa = cfa or (description.sensor.cfa if description else None)
    white = read_exposures(whites, cfa=cfa)
    dark_frames = read_exposures(darks, white[0], cfa)
    band_frames = {wavelength: read_exposures([p for w, p in bands if w == wavelength], white[0], cfa) for wavelength in dict.fromkeys(w for w, _ in bands)}
    every = [*white, *(e for group in band_frames.values() for e in group)]
    check_exposure_times(every)
    reference = white[0].seconds
    dark = make_dark([e.values for e in dark_frames], [e.seconds for e in dark_frames], white[0].black, white[0].values.shape)
    noise = _noise(white, dark, list(band_frames.values()), description)

    signal, _ = merge([e.values for e in white], [e.seconds for e in white], dark, white[0].white, reference)
    if np.isnan(signal).mean() > 0.05:
        raise InputError(f"{np.isnan(signal).mean():.0%} of the white image is saturated", white[0].path, "expose it for less time")
    grid = _grid(signal, white[0], lattice, near)
    window = _window(grid)
    data, attrs = _describe_grid(grid, window, white[0].values.shape)
    bad = _bad(signal, dark, white[0])
    data |= _white(signal, bad, data, shared)
    data["dark/mean"] = dark.mean.astype(np.float32)
    merged = {w: merge([e.values for e in group], [e.seconds for e in group], dark, group[0].white, reference) for w, group in band_frames.items()}
    if merged:
        shares = {w: np.mean([1.0 if e.seconds is None or reference is None else e.seconds / reference for e in group]) for w, group in band_frames.items()}
        _response(data, attrs, merged, shares, dict(radiances), bad, noise, dark.variance, shared, grid, white[0].cfa, denoise)
    _add_attrs(attrs, white[0], dark, noise, reference)
    report = _report(grid, attrs, data, whites, noise)
    write_artefact(output, Artefact("calibration", data, attrs, Provenance(command, describe_inputs(roles), None, description.text if description else "")), overwrite=overwrite)
    return report | {"output": str(output)}


def _band_roles(bands):
    roles = {}
    for wavelength, path in bands:
        roles.setdefault(f"band {wavelength * 1e9:.6g}nm", []).append(path)
    return roles


def _noise(white, dark, band_groups, camera):
    """Gain and read variance: from the camera description, else the files, else two frames of one scene."""
    from plenocli.sensor.frames import photon_transfer

    if camera is not None and white[0].units == "DN":
        return Noise(camera.sensor.gain, (camera.sensor.gain * camera.sensor.read_noise) ** 2 + 1 / 12, "camera")
    if white[0].sigma is not None:
        return Noise(0.0, white[0].sigma**2, "white noise of the simulation")
    gain, source, read = white[0].gain, "file", None if dark.sigma is None else dark.sigma**2
    for group in [white, *band_groups]:
        pairs = [(a, b) for a, b in zip(group[::2], group[1::2]) if a.seconds == b.seconds and a.path != b.path]
        if gain is None or read is None:
            for a, b in pairs[:1]:
                limit = np.mean(a.black) + 0.9 * (a.white - np.mean(a.black)) if np.isfinite(a.white) else np.inf
                found = photon_transfer(a.values - dark.at(a.seconds), b.values - dark.at(b.seconds), limit - np.mean(a.black))
                if found:
                    gain, read, source = (found[0] if gain is None else gain), (found[1] if read is None else read), "photon transfer of repeated frames"
    return Noise(gain, read if read is not None else 1 / 12, source if gain is not None else "unknown")


def _grid(signal, white, lattice, near):
    from plenocli.sensor.grid import find_grid

    try:
        return find_grid(np.where(np.isnan(signal), np.nanmax(signal), signal), white.cfa, None, lattice, near)
    except (NumericsError, InputError) as error:
        raise type(error)(error.what, white.path, error.fix) from None


def _window(grid):
    """Rows and columns of a superpixel window: the pitch, whole; a hexagonal cell's bounding square."""
    size = np.abs(np.array([grid.basis[0, 0], grid.basis[1, 1]])) if grid.kind == "square" else np.full(2, grid.pitch.max())
    return tuple(int(n) for n in (np.rint(size) if grid.kind == "square" else np.ceil(size)))


def _describe_grid(grid, window, shape):
    from plenocli.sensor.superpixel import inside, windows

    origin = windows(grid.centres, window)
    valid = grid.valid & inside(origin, window, shape)
    if not valid.any():
        raise NumericsError("no lenslet lies wholly on the sensor", fix="use a larger part of the sensor")
    data = {"grid/centre": grid.centres, "grid/valid": valid, "grid/residual": grid.residual, "response/origin": origin, "response/window": np.array(window)}
    attrs = {"grid": dict(lattice=grid.kind, pitch=[float(p) for p in grid.pitch], angle=grid.angle, rms=grid.rms, lenslets=int(valid.sum()),
                          offset=[float(c) for c in grid.centres[0, 0]], model={"kind": grid.model, "vectors": grid.basis.tolist()})}
    return data, attrs


def _bad(signal, dark, white):
    from plenocli.sensor.frames import bad_pixels

    return bad_pixels(signal, dark, white.white, 1 if white.cfa == "mono" else 2) | np.isnan(signal)


def _white(signal, bad, data, shared):
    """White reference by superpixel, its level (98th percentile) and the flat field: white over that level."""
    from plenocli.sensor.superpixel import extract

    origin, window, valid = data["response/origin"], tuple(data["response/window"]), data["grid/valid"]
    clean = np.where(bad, np.nan, signal)
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
    return {"white/flat": flat, "white/level": level, "response/white": _mean(cells[valid]) if shared else cells}


def _mean(cells):
    """Mean over the first axis of the values known; NaN where none is."""
    known = np.isfinite(cells)
    with np.errstate(invalid="ignore"):
        return (np.where(known, cells, 0).sum(axis=0, dtype=float) / known.sum(axis=0)).astype(np.float32)


def _response(data, attrs, merged, shares, radiances, bad, noise, dark_variance, shared, grid, cfa, denoise=False):
    """F-hat: each band's signal over the radiance of its source, with its variance (pixel, band), mean over lenslets.

    shares: exposure of one frame of each band over the reference exposure.
    """
    from plenocli.sensor.superpixel import extract
    from plenocli.solvers.spectral import calibration_bias, choose_pixels, column_angles, condition_number

    origin, window, valid = data["response/origin"], tuple(data["response/window"]), data["grid/valid"]
    unknown = [w for w in radiances if not any(abs(w - band) < 1e-12 for band in merged)]
    if unknown:
        raise UsageError(f"--band-radiance names {unknown[0] * 1e9:g} nm, of which there is no --band")
    if shared:
        _check_shared(grid, origin, valid, cfa)
    response = np.full((*valid.shape, window[0] * window[1], len(merged)), np.nan, np.float32)
    variance = np.full((window[0] * window[1], len(merged)), np.nan)
    energy = np.ones(len(merged))
    for k, (wavelength, (signal, weight)) in enumerate(merged.items()):
        energy[k] = next((r for w, r in radiances.items() if abs(w - wavelength) < 1e-12), 1.0)
        cells = extract(np.where(bad, np.nan, signal), origin, window)
        light = cells[valid][np.isfinite(cells[valid])]
        if not light.size or light.mean() < 6 * light.std() / np.sqrt(light.size):
            raise NumericsError(f"the captures at {wavelength * 1e9:g} nm hold no light above the dark level", fix="check that dark and band files are not swapped")
        times = extract(weight.astype(np.float32), origin, window)
        response[..., k] = cells / np.float32(energy[k])
        if noise.gain is not None:
            # read noise comes once a frame, however short: a share of the reference exposure each
            single = (noise.gain * np.clip(cells[valid], 0, None) + noise.read_variance / shares[wavelength]) / times[valid] + dark_variance
            variance[:, k] = _mean(single) / energy[k] ** 2
    response[~valid] = np.nan
    if shared:
        response = _mean(response[valid])
        variance = variance / valid.sum()
    sample = response if shared else response[valid]
    notes = ()
    if denoise:
        variance, notes = _cleaned(response, variance, valid, origin % 2 @ [2, 1] if cfa != "mono" else np.zeros(valid.shape, int))
        sample = response[valid]
    condition = condition_number(sample)
    angles = np.atleast_3d(column_angles(sample)).reshape(-1, len(merged), len(merged))
    between = angles[(slice(None), *np.triu_indices(len(merged), 1))]
    middle = sample if shared else _mean(sample)
    data |= {"response/F": response, "response/wavelength": np.array(list(merged)), "response/energy": energy}
    attrs["response"] = dict(condition=float(np.median(condition)), angles=[[float(a) for a in row] for row in np.median(angles, axis=0)], single_pixel=[int(p) for p in choose_pixels(middle)],
                             notes="; ".join([f"smallest angle between two columns of F {between.min():.2f} deg" if between.size else "one band", *notes]))
    if noise.gain is not None:
        data["response/covariance"] = variance
        some = sample if shared else sample[:: max(1, len(sample) // 32)]
        bias = np.atleast_3d(calibration_bias(some, variance)).reshape(-1, len(merged), len(merged))
        attrs["response"]["bias"] = [float(v) for v in np.median(np.diagonal(bias, axis1=-2, axis2=-1), axis=0)]


def _cleaned(response, variance, valid, phase):
    """Take noise off the response (in place); (variance of what is left, notes). NumericsError where the noise is not known."""
    from plenocli.solvers.lowrank import low_rank

    if not np.isfinite(variance).all(axis=0).any():
        raise NumericsError("the noise of the captures is not known, and so not what stands out of it", fix="give --camera, or two frames of a scene, or leave --denoise out")
    response[valid], left, rank = low_rank(response[valid], variance, phase[valid])
    return variance * left, (f"denoised to rank {rank}: {left:.1%} of the noise variance left",)


def _check_shared(grid, origin, valid, cfa):
    """One F serves all lenslets only where every window sees its lenslet, and its colours, at the same place."""
    phase = (grid.centres - origin)[valid]
    if np.ptp(phase, axis=0).max() > 0.1:
        raise NumericsError(f"lenslets sit at different places within their windows (by up to {np.ptp(phase, axis=0).max():.2f} px): no F serves them all", fix="leave --shared out")
    if cfa != "mono" and np.ptp(origin[valid] % 2, axis=0).any():
        raise NumericsError("windows start on different colours of the filter array: no F serves them all", fix="leave --shared out")


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
    worst = np.unravel_index(np.nanargmax(np.where(grid.valid, grid.residual, np.nan)), grid.valid.shape)
    report = dict(lattice=grid.kind, pitch_px=[float(p) for p in grid.pitch], angle_deg=grid.angle, rms_px=grid.rms, model=grid.model,
                  residual_median_px=float(np.nanmedian(grid.residual[grid.valid])), residual_worst_px=float(grid.residual[worst]), residual_worst_lenslet=[int(n) for n in worst],
                  lenslets=int(data["grid/valid"].sum()), array=list(data["grid/valid"].shape), window=[int(n) for n in data["response/window"]],
                  noise=noise.source, gain_dn_per_e=noise.gain)
    if "response" in attrs:
        report |= dict(bands_nm=[float(w * 1e9) for w in data["response/wavelength"]], condition=attrs["response"]["condition"], columns=attrs["response"]["notes"],
                       angles_deg=attrs["response"]["angles"], bias=attrs["response"].get("bias"))
    truth = true_centres(whites[0])
    if truth is not None:
        from scipy.spatial import cKDTree

        miss, _ = cKDTree(truth.reshape(-1, 2)).query(data["grid/centre"][data["grid/valid"]])
        report["deviation_px"] = float(np.sqrt(np.mean(miss**2)))
        note(f"the simulated capture knows its centres: found within {report['deviation_px']:.4f} px rms")
    return report
