"""The optics of a volume, before a microscope or a photographic camera."""

from __future__ import annotations

import math

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.forward.camera.microscope import Microscope
from plenocli.forward.camera.model import Camera
from plenocli.forward.volume.optics import Term, VolumeOptics


def optics_of(camera: Microscope) -> VolumeOptics:
    """Objective, lenslets and pixels of a microscope over the wavelengths of its light.

    camera: the description.
    """
    lens, array, sensor = camera.objective, camera.lenslet_array, camera.sensor
    mismatch = None
    if lens.specimen_index is not None and lens.specimen_depth is not None:
        mismatch = (lens.medium_index, lens.specimen_depth)
    return VolumeOptics(
        wavelength=camera.light.design_wavelength,
        band=camera.light.wavelengths if len(camera.light.wavelengths) > 1 else (),
        aperture=lens.numerical_aperture,
        index=lens.specimen_index or lens.medium_index,
        magnification=lens.magnification,
        pitch=array.pitch,
        open_width=array.pitch * array.fill_factor,
        lattice=array.lattice,
        opening=array.aperture_shape,
        focal_length=array.focal_length,
        sensor_distance=sensor.distance,
        pupil_distance=math.inf,
        pixels=sensor.pixels_per_lenslet,
        pixel_width=math.sqrt(sensor.pixel_fill_factor),
        depths=camera.object.planes,
        places=camera.object.planes,
        scales=(1.0,) * len(camera.object.planes),
        apodised=True,
        rings=lens.rings,
        mismatch=mismatch,
        terms=tuple(Term(noll=t.noll, coefficient=t.coefficient) for t in lens.aberrations),
    )


def optics_of_camera(camera: Camera) -> VolumeOptics:
    """A photographic camera with [object] planes, as a thin lens without colour, over the
    wavelengths of its light.

    A point at distance z1 is behind the lens in focus 1/z1 = 1/f - 1/z2 - eps: its wave at the
    lenslets is that of a point z2^2 eps away from focus, paraxially, seen through a pupil z2 away.

    Raises ConfigError for pupils that are not round, or not those of a thin lens.
    """
    lens, array, sensor, z2 = (
        camera.main_lens,
        camera.lenslet_array,
        camera.sensor,
        camera.lenslet_array.distance,
    )
    if lens.aperture_shape != "circle" or camera.filter_array is not None:
        raise ConfigError(
            "volumes are computed through a clear round pupil",
            "main_lens.aperture_shape",
            "leave [object] planes and layers out",
        )
    if lens.prescription is not None or lens.wavefront is not None or lens.field:
        raise ConfigError(
            "volumes are computed for a thin lens with Zernike terms",
            "main_lens",
            "leave prescription, wavefront and field out",
        )
    planes = camera.object.planes
    if planes is None:
        raise ConfigError("has no planes", "object", 'add planes = "380 mm to 420 mm step 10 mm"')
    out_of_focus = (1 / lens.focal_length - 1 / np.array(planes) - 1 / z2) * z2**2
    return VolumeOptics(
        wavelength=camera.light.design_wavelength,
        band=camera.light.wavelengths if len(camera.light.wavelengths) > 1 else (),
        aperture=lens.aperture_diameter / 2 / z2,
        index=math.inf,
        magnification=1.0,
        pitch=array.pitch,
        open_width=array.pitch * array.fill_factor,
        lattice=array.lattice,
        opening=array.aperture_shape,
        focal_length=array.focal_length,
        sensor_distance=sensor.distance,
        pupil_distance=z2,
        pixels=sensor.pixels_per_lenslet,
        pixel_width=math.sqrt(sensor.pixel_fill_factor),
        depths=tuple(out_of_focus.tolist()),
        places=planes,
        scales=tuple(plane / z2 for plane in planes),
        apodised=False,
        terms=tuple(Term(noll=t.noll, coefficient=t.coefficient) for t in lens.aberrations),
    )
