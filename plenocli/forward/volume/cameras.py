"""The optics of a volume, of a microscope or of a photographic camera with planes."""

from __future__ import annotations

import math

from plenocli.forward.camera.microscope import Microscope
from plenocli.forward.volume.optics import Term, VolumeOptics


def optics_of(camera: Microscope) -> VolumeOptics:
    """Objective, lenslets and pixels of a microscope at its design wavelength.

    camera: the description.
    """
    lens, array, sensor = camera.objective, camera.lenslet_array, camera.sensor
    mismatch = None
    if lens.specimen_index is not None and lens.specimen_depth is not None:
        mismatch = (lens.medium_index, lens.specimen_depth)
    return VolumeOptics(
        wavelength=camera.light.design_wavelength,
        aperture=lens.numerical_aperture,
        index=lens.specimen_index or lens.medium_index,
        magnification=lens.magnification,
        pitch=array.pitch,
        open_width=array.pitch * math.sqrt(array.fill_factor),
        focal_length=array.focal_length,
        sensor_distance=sensor.distance,
        pupil_distance=math.inf,
        pixels=sensor.pixels_per_lenslet,
        pixel_width=math.sqrt(sensor.pixel_fill_factor),
        depths=camera.object.planes,
        apodised=True,
        rings=lens.rings,
        mismatch=mismatch,
        terms=tuple(Term(noll=t.noll, coefficient=t.coefficient) for t in lens.aberrations),
    )
