"""simulate-response: the response matrix F of every superpixel, predicted from the
description of the camera.
"""

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.stages.forward.capture_sim import WHITE_LEVEL

WAVES_ERR = 0.03
"""What F by waves is taken to be known to, relative (L2) in every band: it agrees with simulated
captures within 2 %, and scenes have light over the whole width of a filter.
"""
RAYS_ERR = 0.12
"""The same for F by rays, where there is nothing by waves beside it."""
DARK = 1e-12
"""Share of an object point's light on the brightest pixel that is none at all."""


@dataclass(frozen=True)
class Settings:
    """What the command line says beyond the camera: wavelengths and bandwidth (fwhm of each band)
    in m, exposure in s (None: the camera's white exposure);

    own_field: light of the lenslet's own object points alone;
    accuracy, superpixels and coherent_ring: of the system matrices, where those are summed.
    """

    wavelengths: tuple = ()
    bandwidth: float = 0.0
    spectral_step: float | None = None
    exposure: float | None = None
    model: str = "auto"
    own_field: bool = False
    accuracy: float | None = None
    superpixels: object = "auto"
    coherent_ring: object = "auto"


@dataclass(frozen=True)
class Places:
    """Superpixel windows on the sensor.

    centre (R, C, 2) px;
    origin (R, C, 2) first pixels;
    window (rows, columns);
    valid (R, C);
    shape of the mosaic;
    shifts (kind, 2): px from a superpixel's centre to its window's middle;
    phases (kind, 2): of the colour filter array at the first pixel;
    kind (R, C): which of these a lenslet has.
    """

    centre: np.ndarray
    origin: np.ndarray
    window: tuple
    valid: np.ndarray
    shape: tuple
    shifts: np.ndarray
    phases: np.ndarray
    kind: np.ndarray


def run_simulate_response(camera_path, output, settings, *, grid=None, overwrite=False, command=""):
    """Predict F and write it as a calibration artefact that demux takes; returns a summary dict.

    grid: a calibration whose lenslets, white, dark and noise are kept; without one they follow from
        the camera. Columns are scaled as captures of simulated narrow-band light are: each band by
        itself fills the brightest pixel to 80 % of full well in the white exposure. Errors:
        ConfigError for the camera, InputError for the grid, UsageError for options that
        exclude each other.
    """
    from plenocli.files.artefacts.container import Artefact, read_artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import camera_files, read_camera

    check_output(output, overwrite=overwrite, inputs=[camera_path, grid], suffixes=(".h5",))
    camera = read_camera(camera_path)
    measured = read_artefact(grid, "calibration") if grid else None
    places = _measured_places(measured, camera, grid) if measured else _places(camera)
    optics = _Optics(camera, settings, places, camera_path)
    bands = tuple(sorted(set(settings.wavelengths))) or camera.light.wavelengths
    response = np.stack(
        [
            _electrons(camera, source, optics, places, settings)
            for source in _narrow(bands, settings)
        ],
        axis=-1,
    )
    if measured:
        data, attrs = (
            dict(measured.data),
            {name: dict(values) for name, values in measured.attrs.items()},
        )
        for name in ("response/F", "response/covariance", "response/energy"):
            data.pop(name, None)
        levels = attrs.get("white", {})
        attrs["response"] = {
            name: levels[name] for name in ("cfa", "gain_e_per_dn", "read_noise") if name in levels
        } | {"units": "DN"}
        if "exposure" in levels:
            attrs["response"]["exposure_s"] = levels["exposure"]
    else:
        white = _electrons(camera, _white(camera, settings), optics, places, settings)
        data, attrs = _ideal(camera, places, white, settings)
    shared = len(places.shifts) == 1
    notes = optics.notes(bands)
    # what a description leaves out is spread evenly over the superpixel: it is not
    # known where it lies
    known = np.array(notes["error"]) * np.sqrt(np.mean(response.astype(float) ** 2, axis=(0, 1)))
    data |= {
        "response/F": response[0] if shared else _spread(response, places),
        "response/wavelength": np.array(bands),
        "response/covariance": np.tile(known**2, (response.shape[1], 1)),
    }
    attrs["response"] |= _conditions(response[_commonest(places)]) | {"notes": notes}
    provenance = Provenance(
        command,
        describe_inputs(camera_files(camera_path, camera) | {"grid": grid}),
        None,
        to_toml(camera),
        optics.record(),
    )
    write_artefact(output, Artefact("calibration", data, attrs, provenance), overwrite=overwrite)
    return _report(output, attrs, places, bands, optics)


def _narrow(bands, settings):
    from plenocli.forward.scene.light import narrow_band

    return bar(
        [narrow_band(wavelength, settings.bandwidth) for wavelength in bands], len(bands), "bands"
    )


def _white(camera, settings):
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant

    return broadband(
        camera,
        lambda wavelengths: illuminant(camera.light.illuminant, wavelengths),
        settings.spectral_step,
    )


# where the superpixels lie


def _places(camera):
    """The windows of all lenslets of the description on the sensor's raster, nearest
    to their chief rays.
    """
    from plenocli.forward.camera.geometry import lenslet_shift
    from plenocli.forward.sensor.superpixel import inside

    count, window = camera.lenslet_array.count, tuple(camera.sensor.pixels_per_lenslet)
    found = [lenslet_shift(camera, r, c) for r in range(count[0]) for c in range(count[1])]
    origin = np.array([(row, column) for row, column, _ in found]).reshape(*count, 2)
    shift = np.array([shift for *_, shift in found]).reshape(*count, 2)
    shape = tuple(n * k for n, k in zip(count, window))
    return _sorted_by_kind(
        origin + (np.array(window) - 1) / 2 - shift,
        origin,
        window,
        inside(origin, window, shape),
        shape,
        shift,
        camera.sensor.cfa,
    )


def _measured_places(measured, camera, path):
    """The windows of a calibration's lenslets."""
    data, cfa = measured.data, measured.attrs.get("white", {}).get("cfa", "mono")
    if cfa != camera.sensor.cfa:
        raise InputError(
            f"has the colour filter array {cfa}, the camera {camera.sensor.cfa}",
            path,
            "correct sensor.cfa",
        )
    if "response/origin" not in data or data["dark/mean"].ndim != 2:
        raise InputError(
            "does not say where its windows and its dark image are", path, "make it with calibrate"
        )
    centre, origin, window = (
        data["grid/centre"],
        data["response/origin"],
        tuple(int(n) for n in data["response/window"]),
    )
    for measured_pitch, pitch in zip(
        np.ravel(measured.attrs["grid"]["pitch"]),
        (camera.superpixel_pitch * camera.lenslet_array.row_spacing, camera.superpixel_pitch),
    ):
        if abs(measured_pitch * camera.sensor.pixel_pitch / pitch - 1) > 0.02:
            note(
                f"warning: lenslets are {measured_pitch:.4g} px apart in the grid, "
                f"{pitch / camera.sensor.pixel_pitch:.4g} px by the camera's description"
            )
    valid = data["grid/valid"].astype(bool)
    shift = np.where(valid[..., None], origin + (np.array(window) - 1) / 2 - centre, 0.0)
    return _sorted_by_kind(centre, origin, window, valid, data["dark/mean"].shape, shift, cfa)


def _sorted_by_kind(centre, origin, window, valid, shape, shift, cfa):
    phase = np.zeros_like(origin) if cfa == "mono" else origin % 2
    # a thousandth of a pixel is far below what a grid is known to
    keys = np.concatenate([np.round(shift, 3), phase], axis=-1).reshape(-1, 4)
    kinds, kind = np.unique(keys[valid.ravel()], axis=0, return_inverse=True)
    where = np.zeros(valid.shape, int)
    where[valid] = kind.ravel()
    return Places(
        centre, origin, window, valid, shape, kinds[:, :2] + 0.0, kinds[:, 2:].astype(int), where
    )


def _commonest(places):
    return int(np.argmax(np.bincount(places.kind[places.valid])))


def _spread(response, places):
    """(kind, pixel[, band]) over the lenslets, NaN where they are not valid."""
    out = response[places.kind].astype(np.float32)
    out[~places.valid] = np.nan
    return out


# light


class _Optics:
    """Response of the superpixels at single wavelengths: by the closed form where it holds, else
    by summing a system matrix.
    """

    def __init__(self, camera, settings, places, where):
        from plenocli.forward.propagation.response import valid_for

        self.camera, self.settings, self.places = camera, settings, places
        asked = "fresnel" if settings.model == "auto" else settings.model
        why = (
            "the exact model has none"
            if asked == "exact"
            else "the lenslet's own field was asked for"
            if settings.own_field
            else valid_for(camera, asked)
        )
        self.closed, self.model = why is None, asked if why is None else settings.model
        self.plan = None
        options = ("accuracy", "superpixels", "coherent_ring")
        if self.closed:
            if given := [name for name in options if getattr(settings, name) not in (None, "auto")]:
                raise UsageError(
                    (
                        f"--{given[0].replace('_', '-')} is of the sum over a system matrix, which "
                        "this response needs none of"
                    ),
                    fix="leave it out, or take --model exact",
                )
            return
        if np.abs(places.shifts).max() > 1e-3:
            raise ConfigError(
                (
                    f"lenslets lie at {len(places.shifts)} different places within their pixels, "
                    f"and there is no closed form: {why}"
                ),
                where,
                "take --model ray, or a superpixel pitch of whole pixels",
            )
        self.request = {name: getattr(settings, name) for name in options} | {"model": self.model}

    def at(self, wavelength):
        """(shift of a kind, pixel), share of the light of one object point."""
        from plenocli.forward.accuracy.dial import pif_builder
        from plenocli.forward.propagation.response import field_response, uniform_response

        if self.closed:
            return uniform_response(self.camera, wavelength, self.model, self.places.shifts)
        builder = pif_builder(self._finely(wavelength), wavelength, **self.request)
        self.plan = builder.plan
        found = field_response(builder)
        own = found[(builder.offsets == 0).all(axis=1)] if self.settings.own_field else found
        return np.broadcast_to(own.sum(axis=0), (len(self.places.shifts), found.shape[1]))

    def _finely(self, wavelength):
        """The camera with as many object points as an even object has diffraction cells: fewer
        leave fringes that an even object has not.
        """
        from plenocli.forward.camera.geometry import geometry

        least = int(np.ceil(geometry(self.camera, wavelength).diffraction_cells)) + 1
        return self.camera.replace(
            **{
                "object.samples_per_lenslet": tuple(
                    max(n, least) for n in self.camera.object.samples_per_lenslet
                )
            }
        )

    def notes(self, bands):
        """What the response's notes record: model, share of light from a lenslet's own field by
        band, rays against waves (relative L2) where both are there, and what F is
        taken to be known to.
        """
        from plenocli.forward.propagation.response import own_light, uniform_response, valid_for

        found = {
            "source": "predicted",
            "model": self.model if self.plan is None else self.plan.model,
            "closed_form": self.closed,
            "own_field": self.settings.own_field,
            "own_light": [own_light(self.camera, w) for w in bands],
        }
        if valid_for(self.camera, "fresnel") is None:
            pairs = [
                [uniform_response(self.camera, w, model)[0] for model in ("ray", "fresnel")]
                for w in bands
            ]
            found["rays_against_waves"] = [
                float(np.linalg.norm(ray - wave) / np.linalg.norm(wave)) for ray, wave in pairs
            ]
        apart = (
            found.get("rays_against_waves", [RAYS_ERR] * len(bands))
            if found["model"] == "ray"
            else np.zeros(len(bands))
        )
        return found | {"error": [float(np.hypot(WAVES_ERR, one)) for one in apart]}

    def record(self):
        from plenocli.forward.propagation.accuracy_record import AccuracyRecord

        if self.closed:
            record = AccuracyRecord(model=self.model, rung="closed form, even object")
        else:
            record = self.plan.accuracy_record()
        return record.as_json()


def _electrons(camera, source, optics, places, settings):
    """Expected signal (kind, pixel), DN, of the white reference under `source` (a Quadrature)."""
    from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
    from plenocli.forward.sensor.cfa import cfa_map, sensitivity

    letters, efficiency = sensitivity(camera, source.wavelengths)
    light = 0.0
    for index, wavelength in enumerate(source.wavelengths):
        light = (
            light
            + (source.photons[index] * efficiency[:, index])[:, None, None]
            * optics.at(wavelength)[None]
        )
    peak = float(light.max())
    if not peak > DARK:
        raise ConfigError(
            f"no light of {source.wavelengths[0] * 1e9:g} nm reaches the sensor",
            "camera",
            "check filters, wavelengths and sensitivities",
        )
    seen = np.stack(
        [
            sum(
                np.where(
                    cfa_map(places.window, camera.sensor.cfa, phase).ravel() == letter,
                    light[n, kind],
                    0.0,
                )
                for n, letter in enumerate(letters)
            )
            for kind, phase in enumerate(places.phases)
        ]
    )
    exposure = settings.exposure or camera.light.white_exposure
    scale = WHITE_LEVEL * camera.sensor.full_well / peak * exposure / camera.light.white_exposure
    return seen * (scale * REFERENCE_REFLECTANCE * camera.sensor.gain)


# the rest of a calibration


def _ideal(camera, places, white, settings):
    """(datasets, attributes) of a calibration without errors: the grid of the description, its
    white, its black level.
    """
    from plenocli.forward.sensor.noise import SensorModel

    sensor, array = camera.sensor, camera.lenslet_array
    pitch = (
        np.array([camera.superpixel_pitch * array.row_spacing, camera.superpixel_pitch])
        / sensor.pixel_pitch
    )
    vectors = [[pitch[0], 0.0 if array.lattice == "square" else pitch[1] / 2], [0.0, pitch[1]]]
    level = white.max(axis=1)
    flat = np.full(places.shape, np.nan, np.float32)
    for (row, column), kind in zip(places.origin[places.valid], places.kind[places.valid]):
        flat[row : row + places.window[0], column : column + places.window[1]] = (
            white[kind] / level[kind]
        ).reshape(places.window)
    shared = len(places.shifts) == 1
    data = {
        "grid/centre": places.centre,
        "grid/valid": places.valid,
        "grid/residual": np.where(places.valid, 0.0, np.nan),
        "response/origin": places.origin,
        "response/window": np.array(places.window),
        "white/flat": flat,
        "white/level": np.where(places.valid, level[places.kind], np.nan).astype(np.float32),
        "response/white": white[0].astype(np.float32) if shared else _spread(white, places),
        "dark/mean": np.full(places.shape, sensor.black_level, np.float32),
    }
    exposure = settings.exposure or camera.light.white_exposure
    model = SensorModel.from_camera(camera)
    read = model.noise.sigma
    noise = {"gain_e_per_dn": 1 / sensor.gain, "read_noise": read, "cfa": sensor.cfa}
    attrs = {
        "grid": dict(
            lattice=array.lattice,
            pitch=pitch.tolist(),
            angle=0.0,
            rms=0.0,
            lenslets=int(places.valid.sum()),
            offset=places.centre[0, 0].tolist(),
            model={"kind": "description", "vectors": [[float(v) for v in row] for row in vectors]},
        ),
        "white": noise
        | dict(
            exposure=exposure,
            black=[float(sensor.black_level)] * 4,
            white=float(model.white_level),
            notes="predicted",
        ),
        "dark": dict(exposure=exposure, sigma=read),
        "response": noise | dict(units="DN", exposure_s=exposure),
    }
    return data, attrs


def _conditions(response):
    """What calibrate says of a measured F: condition, angles between columns
    (degrees), brightest pixels.
    """
    from plenocli.inverse.spectra.demultiplex import choose_pixels, column_angles, condition_number

    angles = np.asarray(column_angles(response), float)
    return dict(
        condition=float(condition_number(response)),
        angles=[[float(a) for a in row] for row in angles],
        single_pixel=[int(p) for p in choose_pixels(response)],
    )


def _report(output, attrs, places, bands, optics):
    found = attrs["response"]
    angles = np.array(found["angles"])
    return {
        "output": str(output),
        "bands_nm": [float(w * 1e9) for w in bands],
        "lenslets": int(places.valid.sum()),
        "array": list(places.valid.shape),
        "window": list(places.window),
        "kinds": len(places.shifts),
        "condition": found["condition"],
        "angles_deg": found["angles"],
        "smallest_angle_deg": float(angles[np.triu_indices(len(bands), 1)].min())
        if len(bands) > 1
        else None,
        **found["notes"],
    }
