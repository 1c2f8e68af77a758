"""capture-sim: source -> optics -> detector, one exposure of a plenoptic camera."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.files.read.scenes import Chart, Uniform, read_scene

WHITE_LEVEL = 0.8
"""Share of full well that a perfect white reaches in [light] white_exposure, at
the brightest pixel.
"""


_MOST = 8 << 30
"""Bytes of memory above which parts of a matrix grow no further: the order of sums, and with it
the last digits, are the same on all larger machines.
"""


@dataclass(frozen=True)
class Settings:
    """What the command line says beyond the files; lengths in m, exposure in s (None: the
    camera's white exposure).
    """

    target: str | None = None
    sampling: str = "fit"
    refine: int = 1
    bandwidth: float = 0.0
    spectral_step: float | None = None
    superpixels: object = "auto"
    coherent_ring: object = "auto"
    accuracy: float | None = None
    model: str = "auto"
    snr_db: float | None = None
    noise: str = "sensor"
    exposure: float | None = None
    seed: int = 0


def run_capture_sim(
    camera_path,
    output,
    settings,
    *,
    scene=None,
    pif=None,
    scene_out=None,
    overwrite=False,
    command="",
):
    """Simulate one capture and write it as .h5, .exr or .dng; returns a summary dict.

    Errors: ConfigError where the camera does not tile the sensor, UsageError for contradicting
    options, InputError for files.
    """
    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import camera_files, read_camera

    output = Path(output)
    if output.suffix not in (".h5", ".exr", ".dng"):
        raise UsageError(
            f"a capture is written as .h5, .exr or .dng, not {output.suffix or 'without a suffix'}",
            output,
            "change the suffix of OUT",
        )
    if output.suffix == ".dng" and (settings.snr_db is not None or settings.noise == "none"):
        raise UsageError(
            "a DNG holds whole numbers of a sensor; --snr and --noise none give real numbers",
            output,
            "write .h5 or .exr",
        )
    check_output(output, overwrite=overwrite, inputs=[camera_path, pif, scene])
    if scene_out:
        check_output(
            scene_out,
            overwrite=overwrite,
            inputs=[camera_path, pif, scene],
            suffixes=(".h5", ".exr"),
        )
    camera = read_camera(camera_path)
    _check_tiling(camera, camera_path)
    _check_memory(camera, settings, camera_path)
    source, what = _source(camera, settings, scene)
    matrix, accuracy = (
        _read_pif(pif, camera, settings, source.wavelengths, camera_path)
        if pif
        else (None, _accuracy(camera, settings, source.wavelengths))
    )
    light, whites, truth = _carry(camera, source, what, settings, matrix)
    capture, summary = _detect(camera, light, whites, settings, scene)
    _describe(capture, camera, settings, truth, scene)
    provenance = dict(
        command=command,
        inputs=describe_inputs(
            camera_files(camera_path, camera)
            | {"pif": pif, "scene": scene if scene and Path(scene).is_file() else None}
        ),
        seed=settings.seed,
        config=to_toml(camera),
        accuracy=accuracy,
    )
    _write(output, capture, provenance, overwrite)
    if scene_out:
        _write_scene(scene_out, truth, camera, provenance, overwrite)
    return summary | {
        "output": str(output),
        "rows": capture["mosaic"].shape[0],
        "columns": capture["mosaic"].shape[1],
        "wavelengths": len(source.wavelengths),
    }


def _check_tiling(camera, where):
    if camera.lenslet_array.lattice != "square":
        raise ConfigError(
            "capture-sim tiles a sensor with superpixels, which a hexagonal lattice does not allow",
            where,
            'set lenslet_array.lattice = "square"',
        )
    drift = max(abs(m) * n / 2 for m, n in zip(camera.pixel_mismatch, camera.lenslet_array.count))
    if drift > 0.05:
        rows, columns = camera.sensor.pixels_per_lenslet
        raise ConfigError(
            (
                "the superpixel pitch is "
                f"{camera.superpixel_pitch / camera.sensor.pixel_pitch:.4f} pixels, not {rows} x "
                f"{columns}: at the array's edge superpixels would be {drift:.2f} pixels off"
            ),
            where,
            (
                "set lenslet_array.superpixel_pitch = "
                f'"{rows * camera.sensor.pixel_pitch * 1e6:.6g} um" instead of pitch'
            ),
        )


def _check_memory(camera, settings, where):
    """Refuse, before any work, a sensor or an object larger than the memory granted: light,
    white and mosaic, float64, by colour.
    """
    from plenocli.base.budget import budget

    lenslets, pixels, points = (
        int(np.prod(n, dtype=object))
        for n in (
            camera.lenslet_array.count,
            camera.sensor.pixels_per_lenslet,
            camera.object.samples_per_lenslet,
        )
    )
    colours = 1 if camera.sensor.cfa == "mono" else 3
    needed = 8 * lenslets * (pixels * (2 * colours + 3) + 2 * points * settings.refine**2)
    budget().require(
        needed,
        "the capture",
        where,
        "take fewer lenslets, pixels or points, a smaller --refine",
    )


def _source(camera, settings, scene):
    """(Quadrature of the light, scene) from --target and --scene."""
    from plenocli.base.units import UnitError, parse_wavelength
    from plenocli.forward.scene.light import broadband, broadened, has_colour, narrow_band
    from plenocli.forward.scene.tables import illuminant
    from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE

    target = settings.target
    if (target is None) == (scene is None):
        raise UsageError(
            "give exactly one of --scene and --target",
            fix="for example --target white or --scene skimage:astronaut",
        )
    if camera.light.band is not None and settings.bandwidth:
        raise UsageError(
            "the camera's light is a band already, given in its [light] section",
            "--bandwidth",
            "leave one of the two out",
        )
    white = broadband(
        camera,
        lambda wavelengths: illuminant(camera.light.illuminant, wavelengths),
        settings.spectral_step,
    )
    if not has_colour(camera) and settings.bandwidth:
        white = broadened(camera.light.wavelengths, settings.bandwidth)
    if scene is not None:
        return white, read_scene(scene, sampling=settings.sampling, spectral=has_colour(camera))
    if target.startswith("mono:"):
        try:
            centre = parse_wavelength(target.removeprefix("mono:"))
        except UnitError as error:
            raise UsageError(str(error), "--target", "write for example mono:450nm") from None
        return narrow_band(centre, settings.bandwidth), Uniform(REFERENCE_REFLECTANCE)
    scenes = {
        "white": Uniform(REFERENCE_REFLECTANCE),
        "dark": Uniform(0.0),
        "colorchecker": Chart(),
    }
    if target not in scenes:
        raise UsageError(
            f"unknown target {target!r}",
            "--target",
            "choose white, dark, mono:450nm or colorchecker",
        )
    return white, scenes[target]


class _Stored:
    """The system matrix of a pif artefact at one of its wavelengths, as a PifBuilder gives it."""

    def __init__(self, artefact, band):
        self.matrix, self.offsets = (
            artefact.data["pif/A"][band],
            artefact.data["pif/lenslet_offset"],
        )

    def blocks(self, size=None):
        yield np.arange(self.matrix.shape[2]), self.matrix


def _read_pif(path, camera, settings, wavelengths, camera_path):
    """(system matrices by wavelength, accuracy record) from a pif artefact; InputError where it
    belongs to another camera or lacks a wavelength.
    """
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.config.camera_file import parse_camera
    from plenocli.files.read.cameras import require_same_files

    artefact = read_pif(path)
    if settings.refine != 1:
        raise UsageError(
            "--refine computes its own finer system matrix and cannot take --pif",
            fix="leave one of them out",
        )
    made_for = parse_camera(artefact.provenance.config, path)
    for section in ("main_lens", "object", "lenslet_array", "sensor", "filter_array"):
        drop = (
            {"count"}
            if section == "lenslet_array"
            else {
                "full_well",
                "read_noise",
                "gain",
                "bits",
                "black_level",
                "quantum_efficiency",
                "cfa",
                "camera",
            }
            if section == "sensor"
            else set()
        )
        ours, theirs = getattr(camera, section), getattr(made_for, section)
        if (ours and ours.model_dump(exclude=drop)) != (theirs and theirs.model_dump(exclude=drop)):
            raise InputError(
                f"was made for another camera: [{section}] differs",
                path,
                "run simulate-pif on this camera",
            )
    require_same_files(camera_path, camera, artefact, path)
    known = artefact.data["pif/wavelength"]
    stored = {}
    for wavelength in wavelengths:
        band = int(np.argmin(np.abs(known - wavelength)))
        if abs(known[band] - wavelength) > 1e-12:
            raise InputError(
                f"has no wavelength {wavelength * 1e9:.4g} nm, which this capture needs",
                path,
                "run simulate-pif with the same --spectral-step, or leave --pif out",
            )
        stored[wavelength] = _Stored(artefact, band)
    return stored, artefact.provenance.accuracy


def _carry(camera, source, scene, settings, matrix):
    """((letters, light on every superpixel by letter), the white superpixel by letter, the
    object as sampled).
    """
    from plenocli.base.budget import budget
    from plenocli.forward.sensor.cfa import sensitivity
    from plenocli.forward.sensor.irradiance import superpixel_light

    letters, efficiency = sensitivity(camera, source.wavelengths)
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    fine = tuple(n * settings.refine for n in samples)
    grid = tuple(n * k for n, k in zip(count, fine))
    finer = (
        camera.replace(**{"object.samples_per_lenslet": fine}) if settings.refine > 1 else camera
    )
    pixels = camera.sensor.pixels_per_lenslet[0] * camera.sensor.pixels_per_lenslet[1]
    light, whites, picture = 0.0, 0.0, None
    for index, wavelength in enumerate(
        bar(source.wavelengths, len(source.wavelengths), "wavelengths")
    ):
        system = matrix[wavelength] if matrix else _build(finer, wavelength, settings)
        if not scene.uniform and (picture is None or scene.spectral):
            picture = scene.at(wavelength, *grid)
        size = max(8, min(budget().memory, _MOST) // 16 // (8 * len(system.offsets) * pixels))
        carried, white = superpixel_light(system.blocks(size), system.offsets, picture, fine)
        if scene.uniform:
            carried = np.broadcast_to(scene.level * white, (*count, pixels))
        weight = (source.photons[index] * efficiency[:, index]).reshape(-1, 1) / settings.refine**2
        light = light + weight[:, :, None, None] * carried[None]
        whites = whites + weight * white[None]
    return (letters, light), whites, _truth(camera, scene, grid, settings.refine)


def _build(camera, wavelength, settings):
    from plenocli.forward.accuracy.dial import pif_builder

    return pif_builder(camera, wavelength, **_request(settings))


def _request(settings):
    """What the dial is asked: with --snr its noise stands in for the sensor's where no
    accuracy is named.
    """
    from plenocli.forward.accuracy.needs import Needs

    needs = (
        None
        if settings.snr_db is None or settings.accuracy is not None
        else Needs(noise=10 ** (-settings.snr_db / 20), source="--snr")
    )
    return dict(
        superpixels=settings.superpixels,
        coherent_ring=settings.coherent_ring,
        accuracy=settings.accuracy,
        model=settings.model,
        needs=needs,
    )


def _accuracy(camera, settings, wavelengths):
    """The accuracy record of a capture that computes its own system matrices: that of the middle
    wavelength's plan. Says how long all will take.
    """
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.accuracy.explain import expectation

    plan = plan_pif(camera, wavelengths=(wavelengths[len(wavelengths) // 2],), **_request(settings))
    expected = expectation(plan, times=len(wavelengths) * settings.refine**2)
    if expected:
        note(expected)
    return plan.accuracy_record().as_json()


def _truth(camera, scene, grid, refine):
    """The object (band, row, column) on the grid that reconstruction uses: area
    averages of the finer one.
    """
    from plenocli.forward.scene.sample import block_mean

    bands = camera.light.wavelengths if scene.spectral else camera.light.wavelengths[:1]
    return np.stack([block_mean(scene.at(w, *grid), (refine, refine)) for w in bands]).astype(
        np.float32
    )


def _detect(camera, light, whites, settings, scene):
    """From relative light to what the sensor reports: (capture dict, summary dict)."""
    from plenocli.base.tiling import to_plane
    from plenocli.forward.sensor.cfa import cfa_map
    from plenocli.forward.sensor.noise import Noise, SensorModel, add_white_noise

    letters, light = light
    sensor, shape = camera.sensor, camera.sensor.pixels_per_lenslet
    planes = {letter: to_plane(plane, shape) for letter, plane in zip(letters, light)}
    mosaic = next(iter(planes.values()))
    if sensor.cfa != "mono":
        where = cfa_map(mosaic.shape, sensor.cfa)
        mosaic = sum(np.where(where == letter, plane, 0.0) for letter, plane in planes.items())
    peak = float(whites.max())
    if not peak > 0:
        raise ConfigError(
            "no light of this source reaches the sensor",
            "camera",
            "check filters, wavelengths and illuminant",
        )
    capture = {"cfa": sensor.cfa}
    rng = stream(settings.seed, "capture-sim")
    if settings.snr_db is not None or settings.noise == "none":
        # relative units: with one wavelength and no colour the mosaic is A x itself
        mosaic = mosaic / (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0)
        noise = Noise()
        if settings.snr_db is not None:
            mosaic, noise = add_white_noise(mosaic, settings.snr_db, rng)
        capture |= dict(
            mosaic=mosaic.astype(np.float64),
            units="relative",
            black=0.0,
            white=float("inf"),
            snr_db=settings.snr_db,
            noise_sigma=noise.sigma,
        )
        return capture, {
            "units": "relative",
            "noise_sigma": noise.sigma,
            "peak": float(mosaic.max()),
        }
    exposure = settings.exposure or camera.light.white_exposure
    scale = WHITE_LEVEL * sensor.full_well / peak * exposure / camera.light.white_exposure
    model = SensorModel.from_camera(camera)
    if not (mosaic.min() >= 0 and np.isfinite(mosaic).all()):
        raise InputError(
            "holds values below 0 or beyond all numbers, which no light has",
            scene,
            "clip it (reconstruct --clip), or use --noise none",
        )
    values = model.expose(mosaic * scale, rng)
    capture |= dict(
        mosaic=values,
        units="DN",
        black=float(sensor.black_level),
        white=float(model.white_level),
        gain_e_per_dn=1 / sensor.gain,
        exposure_s=exposure,
        electrons_per_unit=scale * (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0),
    )
    saturated = float(np.mean(mosaic * scale >= sensor.full_well))
    if saturated > 0.001:
        note(
            f"{saturated:.1%} of the pixels are over full well; a shorter "
            "--exposure would keep them"
        )
    return capture, {
        "units": "DN",
        "peak": int(values.max()),
        "saturated": saturated,
        "exposure_s": exposure,
    }


def _describe(capture, camera, settings, truth, scene):
    """What later stages need to know beside the mosaic."""
    rows, columns = camera.sensor.pixels_per_lenslet
    count = camera.lenslet_array.count
    first = np.array([(rows - 1) / 2, (columns - 1) / 2])
    index = np.stack(np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing="ij"), axis=-1)
    capture.update(
        scene=truth,
        wavelength=np.array(camera.light.wavelengths[: len(truth)]),
        lenslet_centre=first + index * np.array([rows, columns]),
        lenslet_count=list(count),
        superpixel_shape=[rows, columns],
        scene_shape=list(truth.shape[1:]),
        target=settings.target or str(Path(str(scene)).name),
        illuminant=camera.light.illuminant,
    )
    if settings.target and settings.target.startswith("mono:"):
        from plenocli.base.units import parse_length

        capture["band_m"] = parse_length(settings.target.removeprefix("mono:"))


DATASETS = ("mosaic", "cfa", "scene", "wavelength", "lenslet_centre")
"""Keys of a capture that are datasets; the others are attributes."""


def _write(output, capture, provenance, overwrite):
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, provenance_texts
    from plenocli.files.images.dng import write_dng
    from plenocli.files.images.mosaic import write_capture_exr

    attrs = {k: v for k, v in capture.items() if k not in DATASETS and v is not None}
    if output.suffix == ".h5":
        data = {f"capture/{k}": v for k, v in capture.items() if k in DATASETS}
        write_artefact(
            output,
            Artefact("capture", data, {"capture": attrs}, Provenance(**provenance)),
            overwrite=overwrite,
        )
        return
    if output.suffix == ".exr":
        words = {name: value for name, value in attrs.items() if value != float("inf")}
        write_capture_exr(
            output,
            capture["mosaic"],
            words | {"cfa": capture["cfa"]},
            attrs=provenance_texts(Provenance(**provenance)),
            overwrite=overwrite,
        )
    else:
        write_dng(
            output,
            capture["mosaic"],
            cfa=capture["cfa"],
            black=capture["black"],
            white=capture["white"],
            exposure_s=capture["exposure_s"],
            xmp_json=attrs | {"provenance": provenance},
            overwrite=overwrite,
        )


def _write_scene(path, truth, camera, provenance, overwrite):
    """The object as sampled, an `image` artefact or EXR: one picture, or one a band of
    [light] wavelengths.
    """
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, provenance_texts
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    texts = provenance_texts(Provenance(**provenance))
    path, wavelengths = Path(path), np.array(camera.light.wavelengths[: len(truth)])
    if path.suffix == ".exr" and len(truth) == 1:
        write_exr(path, {"Y": truth[0]}, texts, overwrite=overwrite)
    elif path.suffix == ".exr":
        write_spectral_exr(
            path, wavelengths, truth, "reflectance", attrs=texts, overwrite=overwrite
        )
    else:
        data = (
            {"image/value": truth[0]}
            if len(truth) == 1
            else {"image/value": truth, "image/wavelength": wavelengths}
        )
        write_artefact(
            path,
            Artefact(
                "image", data, {"image": {"method": "object as sampled"}}, Provenance(**provenance)
            ),
            overwrite=overwrite,
        )
