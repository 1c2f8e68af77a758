"""Small cameras for the tests of the optics."""

from plenocli.files.config.camera_file import parse_camera
from plenocli.forward.accuracy import dial as accuracy
from plenocli.forward.camera.model import Camera

TEXT = """
[main_lens]
focal_length = "50 mm"
aperture_diameter = "6.875 mm"
[object]
distance = "550 mm"
samples_per_lenslet = [8, 8]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "26 um"
focal_length = "208 um"
count = [3, 3]
[sensor]
distance = "208 um"
pixel_pitch = "2 um"
pixels_per_lenslet = [13, 13]
[light]
wavelengths = ["550 nm"]
"""

WAVELENGTH = 550e-9


def small_camera(**changes):
    """f/8, 26 um superpixels of 13x13 pixels, 8x8 points, in focus, sensor at the lenslets'
    focus; dotted keys change it.
    """
    data = parse_camera(TEXT).model_dump()
    for key, value in changes.items():
        section, _, name = key.partition("__")
        data[section] = data[section] | {name: value} if name else value
    return Camera.model_validate(data, context={"si": True})


def pupil_conjugate(camera):
    """Sensor distance (m) at which the lenslets image the main lens's pupil: kappa = 0."""
    f2, z2 = camera.lenslet_array.focal_length, camera.lenslet_array.distance
    return f2 * z2 / (z2 - f2)


def plan_pif(camera, **request):
    """The plan of the paraxial model at 1e-4, unless `request` says otherwise."""
    return accuracy.plan_pif(
        camera, **{"model": "fresnel", "accuracy": 1e-4, "dtype": "float32"} | request
    )


def system_matrix(camera, **request):
    """The matrix of the paraxial model at 1e-4, unless `request` says otherwise."""
    return accuracy.system_matrix(
        camera, **{"model": "fresnel", "accuracy": 1e-4, "dtype": "float32"} | request
    )


def pif_builder(camera, wavelength, **request):
    """A builder of the paraxial model at 1e-4, unless `request` says otherwise."""
    return accuracy.pif_builder(
        camera, wavelength, **{"model": "fresnel", "accuracy": 1e-4, "dtype": "float32"} | request
    )
