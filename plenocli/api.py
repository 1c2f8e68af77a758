"""plenocli from Python: the functions of the commands, arrays in and typed results out.

    import plenocli as pc

    camera = pc.read_camera(pc.sample("seed_spatial.toml"))
    A = pc.system_matrix(camera, accuracy=1e-4)
    capture = pc.simulate_capture(camera, "skimage:astronaut", snr_db=60, matrix=A)
    image = pc.reconstruct(capture, A, method="lmmse")
    print(pc.score(image, capture.scene).psnr_db)

Nothing here writes a file. Rows go down and come first, lengths are metres, white is 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from plenocli.base.budget import Budget, one_thread, within
from plenocli.base.device import device as device_named
from plenocli.base.errors import UsageError
from plenocli.evaluation.metrics.quality import PictureScore, score_picture
from plenocli.evaluation.metrics.spectral import CubeScore, score_cube
from plenocli.files.images.mosaic import read_capture
from plenocli.files.read.calibrations import read_calibration
from plenocli.files.read.cameras import read_camera
from plenocli.files.read.scenes import read_scene
from plenocli.files.read.training import read_training
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.propagation.models import on_device
from plenocli.forward.propagation.plan import PifPlan
from plenocli.forward.propagation.system_matrix import SystemMatrix, build_pif
from plenocli.forward.scene.light import band_weights, broadband, broadened, has_colour
from plenocli.forward.scene.scenes import Photograph, Scene
from plenocli.forward.scene.tables import illuminant
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.capture import Capture
from plenocli.forward.sensor.exposure.matrices import StoredMatrix
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.simulate import (
    SimulatedCapture,
    require_memory_for,
    require_tiling,
)
from plenocli.forward.sensor.exposure.simulate import simulate_capture as expose
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.calibration import measure
from plenocli.inverse.calibration.calibration import Calibration
from plenocli.inverse.fit.camera_fit import CameraFit
from plenocli.inverse.fit.captures import believed_model, captured_lenslets
from plenocli.inverse.fit.fit import fit_camera as fit_to_captures
from plenocli.inverse.fit.optics import parameters_without
from plenocli.inverse.lightfield.gather import bands_of
from plenocli.inverse.lightfield.light_field import refocused, usual_slopes
from plenocli.inverse.lightfield.optics import Optics
from plenocli.inverse.lightfield.planes import LightField
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, gathered
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.superpixels import superpixels
from plenocli.inverse.prior.natural_images import TrainingPicture, at_scales, split_by_scene
from plenocli.inverse.sparse import dictionary as sparse
from plenocli.inverse.sparse.dictionary import INCOHERENCE, PULL, Dictionary
from plenocli.inverse.sparse.learning import advance, learner_for
from plenocli.inverse.spectra.bands import stokes
from plenocli.inverse.spectra.demultiplexer import Demultiplexer, method_of_white, tell_misfit
from plenocli.inverse.spectra.spectra import Spectra

__all__ = [
    "AccuracyRecord",
    "Budget",
    "Calibration",
    "Camera",
    "Capture",
    "CameraFit",
    "CubeScore",
    "Dictionary",
    "LightField",
    "Noise",
    "PictureScore",
    "PifPlan",
    "Reconstruction",
    "SimulatedCapture",
    "Spectra",
    "SystemMatrix",
    "calibrate",
    "demultiplex",
    "fit_camera",
    "learn_dictionary",
    "plan",
    "read_calibration",
    "read_camera",
    "read_capture",
    "reconstruct",
    "refocus",
    "sample",
    "score",
    "simulate_capture",
    "system_matrix",
    "within",
]

Picture = np.ndarray


def sample(name: str) -> Path:
    """A description that comes with plenocli, such as "seed_spatial.toml" or "tiny.toml".

    Raises UsageError where there is none of this name.
    """
    from importlib.resources import files

    found = Path(str(files("plenocli") / "samples" / name))
    if not found.is_file():
        known = ", ".join(sorted(path.name for path in found.parent.glob("*.toml")))
        raise UsageError(f"there is no sample {name!r}", fix=f"known: {known}")
    return found


def plan(
    camera: Camera,
    *,
    wavelengths: Sequence[float] | None = None,
    superpixels: str | tuple[int, int] = "auto",
    coherent_ring: str | int = "auto",
    accuracy: float | None = None,
    model: str = "auto",
    dtype: np.typing.DTypeLike = "auto",
    lenslet: tuple[int, int] | None = None,
) -> PifPlan:
    """How a system matrix would be computed, what that costs and why; nothing is computed.

    wavelengths: m (default: the camera's).
    superpixels: kept, odd (rows, columns), or "auto".
    coherent_ring: rings of lenslets beyond the superpixels kept and the blur whose fields add
        too, 0 for isolated ones, or "auto".
    accuracy: relative L2 error of the worst column; None: what the sensor's noise lets be seen.
    model: "auto", "ray", "fresnel" or "exact".
    dtype: of the matrix, float32, float64 or "auto".
    lenslet: (row, column) of one off the axis, None for that on the axis.

    Returns the plan; plenocli.forward.accuracy.explain.explain puts it in words.
    Raises UsageError or NumericsError where the request cannot be met.
    docs/model.md, "The dial".
    """
    return plan_pif(
        camera,
        wavelengths=wavelengths,
        superpixels=superpixels,
        coherent_ring=coherent_ring,
        accuracy=accuracy,
        model=model,
        dtype=dtype,
        lenslet=lenslet,
    )


def system_matrix(
    camera: Camera,
    *,
    wavelengths: Sequence[float] | None = None,
    superpixels: str | tuple[int, int] = "auto",
    coherent_ring: str | int = "auto",
    accuracy: float | None = None,
    model: str = "auto",
    dtype: np.typing.DTypeLike = "auto",
    lenslet: tuple[int, int] | None = None,
    device: str = "cpu",
) -> SystemMatrix:
    """The system matrix A of a camera, with the record of its accuracy; arguments as for `plan`.

    device: "cpu" or "cuda", where the products of an exact model are compressed.

    Returns A (band, superpixel, pixel, point) and what belongs to it.
    Raises UsageError or NumericsError where the request cannot be met.
    Berkner et al. 2013, section 2-3-1; docs/model.md, section 4.
    """
    chosen = plan(
        camera,
        wavelengths=wavelengths,
        superpixels=superpixels,
        coherent_ring=coherent_ring,
        accuracy=accuracy,
        model=model,
        dtype=dtype,
        lenslet=lenslet,
    )
    with one_thread():
        return build_pif(camera, on_device(chosen, device))


def simulate_capture(
    camera: Camera,
    scene: Picture | Scene | str | Path,
    *,
    matrix: SystemMatrix | None = None,
    snr_db: float | None = None,
    noise: str = "sensor",
    exposure_s: float | None = None,
    refine: int = 1,
    bandwidth: float = 0.0,
    accuracy: float | None = None,
    model: str = "auto",
    seed: int = 0,
) -> SimulatedCapture:
    """One exposure of a scene.

    scene: linear picture (row, column) or (row, column, red green blue), white is 1; or what
        capture-sim takes: "colorchecker", "skimage:astronaut", a file.
    matrix: of this camera, with the wavelengths of its light; None: computed, with `accuracy` and
        `model` as for system_matrix.
    snr_db: of white noise instead of the sensor's own, dB.
    noise: "sensor", or "none".
    exposure_s: s, None for the camera's white exposure.
    refine: object points per side for each of the camera's, for data finer than the inversion.
    bandwidth: of the light about each wavelength, m.
    seed: of the noise.

    Returns the capture, the object as sampled and its wavelengths.
    Raises ConfigError where superpixels do not tile the sensor, NumericsError where memory or
    accuracy do not suffice, UsageError where the matrix lacks a wavelength.
    Berkner et al. 2013, section 2.
    """
    options = ExposureOptions(
        refine=refine,
        accuracy=accuracy,
        model=model,
        snr_db=snr_db,
        noise=noise,
        exposure=exposure_s,
        seed=seed,
    )
    require_tiling(camera, "camera")
    require_memory_for(camera, options, "camera")
    light = broadband(camera, lambda w: illuminant(camera.light.illuminant, w))
    if bandwidth and not has_colour(camera):
        light = broadened(camera.light.wavelengths, bandwidth)
    name = str(scene) if isinstance(scene, str | Path) else "picture"
    return expose(
        camera,
        light,
        _scene(scene, spectral=has_colour(camera)),
        options,
        matrices=None if matrix is None else _by_wavelength(matrix, light.wavelengths, refine),
        name=name,
    )


def calibrate(
    white: Capture | Sequence[Capture],
    *,
    dark: Capture | Sequence[Capture] = (),
    bands: Mapping[float, Capture | Sequence[Capture]] | None = None,
    radiances: Mapping[float, float] | None = None,
    camera: Camera | None = None,
    response: str = "auto",
    lattice: str = "auto",
) -> Calibration:
    """Lenslet grid, white and dark, and from narrow-band captures the response F of a camera.

    white, dark: one or several captures of an evenly lit white, and without light.
    bands: captures by the wavelength (m) of the narrow band that lit the white.
    radiances: of these sources relative to each other, by wavelength; 1 where not given.
    camera: its description, for gain and read noise; None: as the captures tell.
    response: "own", "shared", "low-rank" or "auto".
    lattice: "auto", "square" or "hexagonal".

    Raises InputError for captures that do not go together, NumericsError where no lattice is found.
    docs/model.md, section 9.
    """
    groups = {w: _several(found) for w, found in sorted((bands or {}).items())}
    found = measure.calibrate(
        _several(white),
        darks=_several(dark),
        bands=measure.NarrowBands(
            wavelengths=list(groups), captures=groups.__getitem__, radiances=dict(radiances or {})
        )
        if groups
        else None,
        camera=camera,
        response=response,
        lattice=lattice,
    )
    return found.calibration


def demultiplex(
    capture: Capture | SimulatedCapture,
    calibration: Calibration,
    *,
    method: str = "auto",
    white: Capture | SimulatedCapture | None = None,
    reflectance: float = REFERENCE_REFLECTANCE,
    register: str = "auto",
    camera: Camera | None = None,
) -> Spectra:
    """Spectra behind every lenslet of a capture, with their standard deviations.

    calibration: with a response.
    method: "pinv", "single-pixel", "wls", "lmmse", "nnls", "coupled", "fine" or "auto".
    white: capture of the white reference, which makes reflectances of radiances.
    reflectance: of that reference.
    register: "auto", "on" or "off", whether motion since the calibration is looked for.
    camera: description of the calibrated camera, from which light of neighbouring lenslets is
        predicted and taken off; None: it stays.

    Raises UsageError for a calibration without a response, InputError where capture and calibration
    do not go together, NumericsError where no lenslet can be demultiplexed.
    Berkner et al. 2013, section 2-3-2; docs/model.md, section 9.
    """
    if calibration.response is None or calibration.white is None:
        raise UsageError("the calibration holds no response", fix="give calibrate narrow bands")
    with one_thread():
        solver = Demultiplexer(
            calibration,
            method=method,
            register=register,
            ratio=white is not None,
            camera=camera,
        )
        found = solver.estimate(_capture(capture), "capture")
        if white is None:
            tell_misfit({"capture": found})
            return stokes(found)
        reference = solver.estimate(_capture(white), "white", method_of_white(method))
        tell_misfit({"capture": found, "white": reference})
        return stokes(found.relative_to(reference, reflectance))


def reconstruct(
    capture: Capture | SimulatedCapture,
    matrix: SystemMatrix,
    *,
    method: str = "auto",
    camera: Camera | None = None,
    calibration: Calibration | None = None,
    dictionary: Dictionary | None = None,
    pictures: Sequence[Picture] | None = None,
    overlap: int | None = None,
    noise_sigma: float | None = None,
    alpha: float | None = None,
    rank: int | None = None,
    lam: float | None = None,
    device: str = "cpu",
    seed: int = 0,
) -> Reconstruction:
    """The picture in front of a camera.

    matrix: of the camera.
    method: "auto", "block-mean", "tikhonov", "tsvd", "nnls", "lmmse", "dictionary", "pnp" or "tv".
    camera: its description, where filters in the pupil make several bands of the wavelengths.
    calibration: along whose lenslets a real capture is cut; None: it was simulated.
    dictionary: that learn_dictionary made, for its method.
    pictures: photographs (row, column) in [0, 1] for the statistics; None: those of scikit-image
        but the captured one.
    overlap: superpixels (a side) looked at for each block, 1 or 3; None as the matrix allows.
    noise_sigma: standard deviation of the noise in units of A x; None: as the capture tells.
    alpha, rank, lam: parameter of tikhonov, tsvd and dictionary; None: chosen.
    device: "cpu" or "cuda", where plug and play works.
    seed: of every random stream.

    Returns the picture (row, column) or (band, row, column), its standard deviation where the
    method knows it, and how it came about.
    Raises InputError where capture and matrix do not go together, NumericsError where there is no
    estimate.
    Berkner et al. 2013, section 3-2; docs/model.md, section 10.
    """
    if method not in METHODS:
        raise UsageError(f"there is no method {method!r}", fix=f"known: {', '.join(METHODS)}")
    if METHODS[method].needs_dictionary and dictionary is None:
        raise UsageError(f"method {method!r} needs a dictionary", fix="learn_dictionary makes one")
    system = _lenslet_matrix(matrix, camera)
    options = Options(
        method=method,
        overlap=overlap,
        noise_sigma=noise_sigma,
        alpha=alpha,
        rank=rank,
        lam=lam,
        seed=seed,
    )

    def read_pictures(scene: str | None) -> list[TrainingPicture]:
        if pictures is None:
            return read_training((), system.object_shape, not_scene=scene)
        return _named(pictures)

    estimators = Estimators(
        system,
        options,
        read_pictures,
        None if dictionary is None else lambda: dictionary,
        threads=1,
        device=device_named(device),
    )
    way = METHODS[method]
    data = superpixels(_capture(capture), system, calibration, each_pixel=way.each_pixel)
    found, _ = estimate(estimators, way, data)
    return found.as_picture(system.object_shape)


def fit_camera(
    camera: Camera,
    captures: Capture | SimulatedCapture | Sequence[Capture | SimulatedCapture],
    *,
    calibration: Calibration | None = None,
    pictures: Sequence[Picture] | None = None,
    noise_sigma: float | None = None,
    fixed: Sequence[str] = (),
    model: str = "auto",
    seed: int = 0,
) -> CameraFit:
    """A camera's description made true by its own captures, of any scenes.

    camera: as described; square lenslets, one wavelength.
    captures: of that camera.
    calibration: along whose lenslets real captures are cut; None: they were simulated.
    pictures: photographs (row, column) in [0, 1] for the statistics; None: those of scikit-image.
    noise_sigma: standard deviation of the noise in units of A x; None: as the captures tell.
    fixed: names of parameters that stay as described.
    model: of propagation; "auto" for the one that simulated captures were made with, or the finest.
    seed: of the training patches.

    Returns the fit: its camera, its parameters with their standard deviations and correlations,
    and whether the camera explains the captures; if not, its camera is the described one.
    Raises UsageError for other cameras, InputError for captures that do not go with the camera.
    docs/model.md, "A camera that fits itself".
    """
    if isinstance(captures, Capture | SimulatedCapture):
        captures = [captures]
    several = [_capture(one) for one in captures]
    shape = camera.object.samples_per_lenslet
    known = read_training((), shape) if pictures is None else _named(pictures)
    lenslets = [
        captured_lenslets(one, camera, calibration, noise_sigma=noise_sigma) for one in several
    ]
    return fit_to_captures(
        camera,
        lenslets,
        [picture for _, picture in at_scales(known, shape)],
        parameters=parameters_without(camera, fixed),
        model=believed_model(model, several),
        seed=seed,
    )


def learn_dictionary(
    matrix: SystemMatrix,
    pictures: Sequence[Picture] | None = None,
    *,
    atoms: int | None = None,
    batch: int | None = None,
    iterations: int = 10,
    lam: float | None = None,
    delta: float = 1e-3,
    pull: float = PULL,
    incoherence: float = INCOHERENCE,
    snr_db: float = 60.0,
    seed: int = 0,
) -> Dictionary:
    """A dictionary of object patches that suits one system matrix.

    pictures: photographs (row, column) in [0, 1], every fifth of which chooses and judges; None:
        those of scikit-image.
    atoms: None for one an object point.
    batch: patches an iteration, None for 4 an atom.
    lam: weight of |c|_1; None: chosen on the held-out pictures.
    delta: weight of |A Phi|^2.
    pull: batches that the atoms so far are worth when they are refitted.
    incoherence: share of a full step that draws atoms apart which the sensor sees alike.
    snr_db: of the measurements that it is learnt from, dB.
    seed: of every random stream.

    Berkner et al. 2013, Fig. 4, Algorithm 1; docs/model.md, section 10.
    """
    from plenocli.inverse.picture.solvers.least_squares import decompose

    system = _lenslet_matrix(matrix, None)
    shape = system.object_shape
    given = read_training((), shape) if pictures is None else _named(pictures)
    training, held_out = (at_scales(part, shape) for part in split_by_scene(given))
    count = atoms or int(np.prod(shape))
    settings = sparse.Settings(
        atoms=count,
        batch=batch or 4 * count,
        lam=np.nan if lam is None else lam,
        lam_rule="validation" if lam is None else "given",
        delta=delta,
        pull=pull,
        incoherence=incoherence,
        snr_db=snr_db,
        seed=seed,
    )
    learner = learner_for(
        decompose(system.own),
        shape,
        settings,
        [picture for _, picture in training],
        [picture for _, picture in held_out],
        workers=1,
    )
    state = learner.start()
    for _ in range(iterations):
        learner, state = advance(learner, state)
    return Dictionary(
        atoms=state.atoms,
        synthesis=state.atoms,
        lam=learner.settings.lam,
        sigma=learner.sigma,
        directions=len(learner.seen),
        training=tuple(sorted({Path(name).name for name, _ in training})),
    )


def refocus(
    capture: Capture | SimulatedCapture,
    *,
    calibration: Calibration | None = None,
    camera: Camera | None = None,
    distances: Sequence[float] = (),
    slopes: Sequence[float] = (),
    views: int = 3,
) -> LightField:
    """Planes of focus, depth and views of one capture.

    calibration: its lenslets and white image; a simulated capture needs none.
    camera: its description, which turns slopes into distances.
    distances: of planes in front of the main lens, m; needs `camera`.
    slopes: of planes, px per px; without either, thirteen around the lenslets' plane, and
        more of them while what has texture lies beyond.
    views: along each side, 0 for none.

    Raises UsageError for distances without a camera, InputError where lenslets or light are
    missing.
    docs/model.md, "Refocusing and depth".
    """
    optics = None if camera is None else Optics.of(camera)
    if distances and optics is None:
        raise UsageError("distances need the camera's description", fix="give camera")
    wanted = [*slopes, *(optics.slope(d) for d in distances if optics is not None)]
    planes = np.array(sorted(set(wanted))) if wanted else usual_slopes()
    source = bands_of(_capture(capture), calibration)
    return refocused(source, planes, views=views, optics=optics, grow=not wanted)


def score(
    result: Reconstruction | Spectra | Picture,
    truth: Picture,
    *,
    block: tuple[int, int] | None = None,
) -> PictureScore | CubeScore | None:
    """How good a result is.

    result: a picture, or spectra (reflectances).
    truth: of the same shape; one band of a picture may have an axis of its own.
    block: points (rows, columns) of an object, for measures by lenslet.

    Returns None for spectra without a lenslet that has all bands.
    Raises UsageError where the shapes differ.
    """
    value = result if isinstance(result, np.ndarray) else result.value
    truth = np.asarray(truth, float)
    truth = truth[0] if truth.ndim == value.ndim + 1 and len(truth) == 1 else truth
    if truth.shape != value.shape:
        raise UsageError(f"the truth is {truth.shape}, the result {value.shape}")
    if isinstance(result, Spectra):
        return score_cube(value, truth, result.wavelength)
    sigma = result.sigma if isinstance(result, Reconstruction) else None
    return score_picture(value, truth, block, sigma)


def _scene(scene: Picture | Scene | str | Path, *, spectral: bool) -> Scene:
    if isinstance(scene, str | Path):
        return read_scene(scene, spectral=spectral)
    if isinstance(scene, np.ndarray):
        values = scene.astype(np.float32)
        return Photograph(values[:, :, None] if scene.ndim == 2 else values, "fit", spectral)
    return scene


def _capture(capture: Capture | SimulatedCapture) -> Capture:
    return capture.capture if isinstance(capture, SimulatedCapture) else capture


def _several(captures: Capture | Sequence[Capture]) -> list[Capture]:
    return [captures] if isinstance(captures, Capture) else list(captures)


def _named(pictures: Sequence[Picture]) -> list[TrainingPicture]:
    return [(f"picture {k}", np.asarray(p, float)) for k, p in enumerate(pictures)]


def _by_wavelength(
    matrix: SystemMatrix, wavelengths: np.ndarray, refine: int
) -> dict[float, StoredMatrix]:
    """The matrix of each wavelength of the light."""
    if refine != 1:
        raise UsageError(
            "a finer object needs a matrix of its own", fix="leave matrix or refine out"
        )
    found = {}
    for wavelength in wavelengths:
        band = int(np.argmin(np.abs(matrix.wavelengths - wavelength)))
        if abs(matrix.wavelengths[band] - wavelength) > 1e-12:
            raise UsageError(
                f"the matrix has no wavelength {wavelength * 1e9:.4g} nm, which the light has",
                fix="compute it for the light's wavelengths, or leave it out",
            )
        found[wavelength] = StoredMatrix(_values(matrix)[band], matrix.lenslet_offset)
    return found


def _lenslet_matrix(matrix: SystemMatrix, camera: Camera | None) -> LensletMatrix:
    bands: tuple[float, ...] = ()
    weights = light = None
    if camera is not None and camera.filter_array is not None:
        light = camera.light.illuminant
        found, weights = band_weights(camera, matrix.wavelengths, lambda w: illuminant(light, w))
        bands = tuple(float(b) for b in found)
    return LensletMatrix(
        path=Path("matrix"),
        blocks=gathered(_values(matrix), weights),
        offsets=np.asarray(matrix.lenslet_offset, int),
        pixel_shape=matrix.pixel_shape,
        object_shape=matrix.object_shape,
        accuracy=matrix.accuracy,
        bands=bands,
        illuminant=light,
    )


def _values(matrix: SystemMatrix) -> np.ndarray:
    if matrix.A is None:
        raise UsageError("the matrix was written in pieces and is not held", fix="read its file")
    return matrix.A
