"""refocus: views, pictures focused at other distances and a depth map from one capture."""

from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError

RANGE = 3.0
"""Slopes from -RANGE to RANGE are searched where no distances are given: a lenslet's width of
parallax across the pupil is one.
"""


def run_refocus(
    capture,
    output,
    *,
    calibration=None,
    camera=None,
    distances=(),
    slopes=(),
    planes=13,
    views=3,
    overwrite=False,
    seed=0,
    command="",
):
    """Refocus one capture and write a light-field artefact; returns a summary dict.

    distances: m, in front of the main lens (needs `camera`, the path of its description);
    slopes: of planes, see sensor.lightfield; without either, `planes` slopes from -RANGE to RANGE.
        A depth map needs at least three planes.
    views: along each side, 0 for none.
    UsageError, InputError, OutputError.
    """
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.inverse.lightfield import refocus as lightfield

    output = Path(output)
    check_output(
        output, overwrite=overwrite, inputs=[capture, calibration, camera], suffixes=(".h5",)
    )
    geometry = _geometry(camera) if camera is not None else None
    slopes = _slopes(slopes, distances, planes, geometry)
    samples, shape = _samples(capture, calibration, len(slopes))
    pictures = np.stack([lightfield.refocus(samples, slope, shape)[0] for slope in slopes])
    sharp = [lightfield.sharpness(p) for p in pictures]
    data = {
        "refocus/value": pictures.astype(np.float32),
        "refocus/slope": slopes,
        "refocus/sharpness": np.array(sharp),
    }
    if geometry:
        data["refocus/distance"] = _finite(lightfield.distance_of(slopes, *geometry))
    if len(slopes) >= 3:
        found, confidence = lightfield.depth(samples, slopes, shape)
        data |= {"depth/slope": found, "depth/confidence": confidence}
        if geometry:
            data["depth/distance"] = _finite(lightfield.distance_of(found, *geometry))
    if views:
        data["views/value"] = lightfield.views(samples, views, shape).astype(np.float32)
    attrs = {
        "refocus": {"pitch": samples.pitch, "step": lightfield.STEP, "pupil": 2 * samples.reach()}
    }
    inputs = describe_inputs({"capture": capture, "calibration": calibration, "camera": camera})
    write_artefact(
        output,
        Artefact("lightfield", data, attrs, Provenance(command, inputs, seed)),
        overwrite=overwrite,
    )
    best = int(np.argmax(sharp))
    return {
        "output": str(output),
        "planes": len(slopes),
        "lenslets": list(shape),
        "sharpest_slope": float(slopes[best]),
        "slopes": slopes.tolist(),
        "sharpness": sharp,
        "sharpest_distance_m": _number(data["refocus/distance"][best]) if geometry else None,
    }


def _finite(distance):
    return np.where(np.isfinite(distance), distance, np.nan)


def _number(value):
    return None if np.isnan(value) else float(value)


def _geometry(path):
    """(focal length, lenslet distance, sensor distance), m, of a camera file."""
    from plenocli.files.read.cameras import read_camera

    camera = read_camera(path)
    return camera.main_lens.focal_length, camera.lenslet_array.distance, camera.sensor.distance


def _slopes(slopes, distances, planes, geometry):
    from plenocli.inverse.lightfield.refocus import slope_of

    if slopes and distances:
        raise UsageError(
            "give planes as --distance or as --slope, not both", "--slope", "leave one of them out"
        )
    if distances:
        if geometry is None:
            raise UsageError(
                "distances need the camera's description",
                "--distance",
                "give --camera, or name planes by --slope",
            )
        slopes = [slope_of(d, *geometry) for d in distances]
    elif not slopes:
        slopes = np.linspace(-RANGE, RANGE, planes)
    return np.array(sorted(set(float(s) for s in slopes)))


PIXEL_BYTES, PLANE_BYTES = 126, 1
"""Memory for each pixel of the capture, and for each of its pixels and each plane (measured)."""


def _samples(capture, calibration, planes=1):
    """(Samples, (rows, columns) of the picture in lenslet pitches) of a capture, along a
    calibration's grid or the tiles that its file names.
    """
    from plenocli.base.budget import budget
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.images.mosaic import read_capture
    from plenocli.inverse.lightfield.refocus import collect

    shot = read_capture(capture)
    budget().require(
        shot.mosaic.size * (PIXEL_BYTES + PLANE_BYTES * planes),
        "refocusing",
        capture,
        "cut the capture",
    )
    if shot.cfa != "mono":
        raise InputError(
            f"has the colour filter array {shot.cfa}; refocusing takes grey captures",
            capture,
            "demultiplex it first",
        )
    if calibration is not None:
        found = read_artefact(calibration, "calibration")
        if "white/flat" not in found.data or found.data["white/flat"].shape != shot.shape:
            raise InputError(
                "holds no white image of this sensor",
                calibration,
                "calibrate with the white image of the camera that took the capture",
            )
        signal, white = (
            shot.mosaic - found.data["dark/mean"],
            np.nan_to_num(found.data["white/flat"]),
        )
        centres, valid = found.data["grid/centre"], found.data["grid/valid"].astype(bool)
        pitch = float(np.mean(found.attrs["grid"]["pitch"]))
        level = found.data.get("white/level")
        # the flat image is 1 in every superpixel: what light each has comes back
        if level is not None:
            signal = signal / float(np.nanmedian(level))
    else:
        size = shot.grid.shape if shot.grid else None
        if size is None:
            raise InputError(
                "does not say where its lenslets are",
                capture,
                "give --calibration (from calibrate) with the white image of this camera",
            )
        count = [shot.shape[axis] // size[axis] for axis in (0, 1)]
        signal = shot.signal()
        # what all superpixels have in common stands for a white image
        mean = signal.reshape(count[0], size[0], count[1], size[1]).mean(axis=(0, 2))
        white = np.tile(mean / mean.max(), count)
        centres = np.stack(
            np.meshgrid(
                *((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size)), indexing="ij"
            ),
            axis=-1,
        )
        valid, pitch = np.ones(count, bool), float(np.mean(size))
        signal = signal / mean.max()
    samples = collect(signal, white, centres, valid, pitch)
    if samples.value.size == 0:
        raise InputError(
            "has no lit superpixel on the grid",
            capture,
            "check the white image and the calibration",
        )
    # pitches are measured
    return samples, tuple(max(1, int(np.ceil(n / pitch - 0.1))) for n in shot.shape)
