"""The response to an even object: traced rays, fields summed by hand, the system matrix, and
where they must meet.
"""

import math

import numpy as np
import pytest

from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.response import (
    field_response,
    own_light,
    uniform_response,
    valid_for,
)
from tests.forward.propagation.cameras import WAVELENGTH, pif_builder, pupil_conjugate, small_camera

FILTERS = dict(
    layout=(2, 2),
    gap=0.3e-3,
    size=4.6e-3,
    filters=[
        dict(center=c, fwhm=60e-9, peak=p, blocking=0.02)
        for c, p in ((450e-9, 0.9), (540e-9, 0.7), (570e-9, 0.8), (650e-9, 0.6))
    ],
)


def traced(camera, count=600_000, seed=1, shift=(0.0, 0.0)):
    """Share of light of each pixel and its standard deviation: rays from random object points
    through random points of the pupil, hop by hop.
    """
    view, rng = geometry(camera, WAVELENGTH), np.random.default_rng(seed)
    lens, radius = camera.main_lens, view.D1 / 2
    # all that the lenslet in the middle can see, corners of hexagons too
    far = 1.2 * view.D2 / 2 + view.blur / 2
    image = rng.uniform(-far, far, (2, count))
    source = -image * view.z1 / view.z2
    pupil = rng.uniform(-radius, radius, (2, count))
    weight = (
        np.ones(count)
        if lens.aperture_shape == "square"
        else (np.hypot(*pupil) < radius) * (np.hypot(*pupil) >= lens.obscuration * radius) * 1.0
    )
    area = (
        view.D1**2
        if lens.aperture_shape == "square"
        else math.pi * radius**2 * (1 - lens.obscuration**2)
    )
    if camera.filter_array is not None:
        side, gap = camera.filter_array.size, camera.filter_array.gap
        through = np.zeros(count)
        for number, f in enumerate(camera.filter_array.filters):
            low = -side / 2 + np.array([number // 2, number % 2]) * (side + gap) / 2
            t = (
                f.peak * math.exp(-4 * math.log(2) * ((WAVELENGTH - f.center) / f.fwhm) ** 2)
                + f.blocking
            )
            through += t * ((pupil > low[:, None]) & (pupil < low[:, None] + (side - gap) / 2)).all(
                axis=0
            )
        weight = weight * through
    slope = (pupil - source) / view.z1 - pupil / view.f1
    u = pupil + view.z2 * slope
    y, x = np.abs(u)
    half = view.lenslet_width / 2
    inside = {
        "square": np.maximum(y, x),
        "circle": np.hypot(y, x),
        "hexagon": np.maximum(x, math.sqrt(0.75) * y + x / 2),
    }[view.lenslet_shape] < half
    t = u + view.z3 * (slope - u / view.f2)
    pixel = [
        np.floor(v / view.pixel_pitch - s + n / 2).astype(int)
        for v, n, s in zip(t, view.pixel_shape, shift)
    ]
    seen = (
        inside
        & (weight > 0)
        & np.all([(p >= 0) & (p < n) for p, n in zip(pixel, view.pixel_shape)], axis=0)
    )
    where = np.ravel_multi_index([p[seen] for p in pixel], view.pixel_shape)
    # the mean over the object points of a field's area, of the share of the pupil's light
    share = (2 * far) ** 2 * view.D1**2 / area / (view.D2**2 * view.row_spacing) / count
    size = int(np.prod(view.pixel_shape))
    return np.bincount(where, weight[seen], size) * share, np.sqrt(
        np.bincount(where, weight[seen] ** 2, size)
    ) * share


BLURRED = dict(object__distance=0.53)  # one lenslet of blur
# no light of a neighbour's superpixel, which the rays above do not follow
NARROW = dict(main_lens__aperture_diameter=4.6e-3)


def bare(**changes):
    """A pupil that stays within its superpixel."""
    return small_camera(**{**NARROW, **changes})


@pytest.mark.parametrize(
    "camera",
    [
        bare(),
        bare(sensor__distance=pupil_conjugate(small_camera())),
        bare(main_lens__aperture_shape="square", filter_array=FILTERS, **BLURRED),
        bare(main_lens__aperture_shape="annulus", main_lens__obscuration=0.4, filter_array=FILTERS),
        bare(lenslet_array__fill_factor=0.7, **BLURRED),
        bare(lenslet_array__aperture_shape="circle"),
        bare(
            lenslet_array__lattice="hexagonal",
            lenslet_array__aperture_shape="hexagon",
            main_lens__aperture_diameter=3.5e-3,
        ),
    ],
    ids=[
        "disc",
        "conjugate",
        "filters",
        "annulus",
        "small lenslets",
        "round lenslets",
        "hexagonal",
    ],
)
def test_areas_are_what_traced_rays_find(camera):
    found = uniform_response(camera, WAVELENGTH, "ray", [(0.3, -0.2)])[0]
    expected, sigma = traced(camera, shift=(0.3, -0.2))
    lit = sigma < 0.1 * expected  # a hundred rays and more
    assert lit.sum() > 20
    miss = (found - expected)[lit] / sigma[lit]
    assert np.abs(miss).max() < 4.5 and miss.std() == pytest.approx(
        1, abs=3 / math.sqrt(2 * lit.sum())
    )
    assert found.sum() == pytest.approx(expected.sum(), abs=4 * np.linalg.norm(sigma))
    assert (found[expected == 0] < 20 * sigma[lit].min()).all()


def by_hand(camera, x, axis=1, nodes=1600):
    """Along one axis: light of each pixel from a point source at each x (m) of the pupil, fields
    summed point by point over the lenslet.
    """
    view = geometry(camera, WAVELENGTH)
    u = (np.arange(nodes) + 0.5) / nodes * view.lenslet_width - view.lenslet_width / 2
    fine = 24
    t = (
        (np.arange(view.pixel_shape[axis] * fine) + 0.5) / fine - view.pixel_shape[axis] / 2
    ) * view.pixel_pitch
    out = np.zeros((len(x), len(t)))
    for m in range(-4, 5):
        here = u + m * view.D2
        kernel = np.exp(
            1j * view.k * ((t[:, None] - here) ** 2 / (2 * view.z3) - u * u / (2 * view.f2))
        ) * (view.lenslet_width / nodes)
        field = kernel @ np.exp(1j * view.k * (here[:, None] - x) ** 2 / (2 * view.z2))
        out += np.abs(field.T) ** 2 / (view.wavelength * view.z3)
    return out.reshape(len(x), -1, fine).mean(axis=2) * view.pixel_pitch / view.D2


def test_waves_are_fields_summed_by_hand(monkeypatch):
    monkeypatch.setattr("plenocli.forward.propagation.response.TAIL", 2)
    camera = small_camera(
        main_lens__aperture_shape="square", lenslet_array__fill_factor=0.9, filter_array=FILTERS
    )
    x = 0.15e-3 + (np.arange(60) + 0.5) / 60 * 2.15e-3
    light, expected = (
        [by_hand(camera, here).mean(axis=0) * 2.15e-3 / 6.875e-3 for here in (-x, x)],
        0.0,
    )
    for number, f in enumerate(small_camera(filter_array=FILTERS).filter_array.filters):
        t = (
            f.peak * math.exp(-4 * math.log(2) * ((WAVELENGTH - f.center) / f.fwhm) ** 2)
            + f.blocking
        )
        expected = expected + t * np.outer(light[number // 2], light[number % 2])
    found = uniform_response(camera, WAVELENGTH, "fresnel")[0].reshape(13, 13)
    assert np.linalg.norm(found - expected) < 2e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("changes", [{}, BLURRED], ids=["in focus", "blurred"])
def test_waves_are_the_sum_of_the_system_matrix(changes):
    """The one through the main lens point by point, with focus, the other without it: an even
    object does not know of focus.
    """
    camera = small_camera(object__samples_per_lenslet=(7, 7), **changes)
    found = uniform_response(camera, WAVELENGTH, "fresnel")[0]
    gap = []
    for size in (5, 9):
        summed = field_response(
            pif_builder(camera, WAVELENGTH, superpixels=(size, size), coherent_ring=1)
        ).sum(axis=0)
        gap.append(np.linalg.norm(summed - found) / np.linalg.norm(found))
    # what is missing is light beyond the superpixels kept, which falls as 1/size
    assert gap[0] < 0.04 and gap[1] < 0.65 * gap[0]


def test_aberrations_do_not_change_the_light_of_an_even_object():
    bent = small_camera(
        main_lens__aberrations=(
            {"noll": 7, "coefficient": 150e-9},
            {"noll": 4, "coefficient": 100e-9},
        ),
        object__samples_per_lenslet=(7, 7),
    )
    plain = uniform_response(small_camera(), WAVELENGTH, "fresnel")[0]
    np.testing.assert_array_equal(uniform_response(bent, WAVELENGTH, "fresnel")[0], plain)
    summed = field_response(pif_builder(bent, WAVELENGTH, superpixels=(7, 7))).sum(axis=0)
    assert np.linalg.norm(summed - plain) < 0.015 * np.linalg.norm(plain)


@pytest.mark.parametrize("conjugate", [True, False])
@pytest.mark.parametrize("shape", ["annulus", "square"])
def test_waves_become_rays_as_the_wavelength_falls(monkeypatch, shape, conjugate):
    monkeypatch.setattr("plenocli.forward.propagation.response.TAIL", 2)
    changes = dict(sensor__distance=pupil_conjugate(small_camera())) if conjugate else {}
    changes |= dict(
        main_lens__aperture_shape=shape, main_lens__obscuration=0.4 if shape == "annulus" else 0.0
    )
    camera, gap = bare(filter_array=FILTERS, **changes), []
    for part in (1, 4, 16):
        ray, wave = (
            uniform_response(camera, WAVELENGTH / part, model)[0] for model in ("ray", "fresnel")
        )
        gap.append(np.abs(wave - ray).sum() / ray.sum())
    # ringing on the rim, lambda z3/D2 wide: proportional but for a logarithm
    assert gap[-1] < 0.05 and all(b < 0.4 * a for a, b in zip(gap, gap[1:]))


def test_large_pixels_see_no_diffraction():
    gap = []
    for side, count in ((2e-6, 13), (26e-6 / 3, 3)):
        camera = small_camera(
            main_lens__aperture_shape="square",
            main_lens__aperture_diameter=4.6e-3,
            sensor__pixel_pitch=side,
            sensor__pixels_per_lenslet=(count, count),
        )
        ray, wave = (uniform_response(camera, WAVELENGTH, model)[0] for model in ("ray", "fresnel"))
        gap.append(np.linalg.norm(wave - ray) / np.linalg.norm(ray))
    assert gap[1] < 0.4 * gap[0]


@pytest.mark.parametrize("model", ["ray", "fresnel"])
@pytest.mark.parametrize(
    "changes, share",
    [
        ({}, 1.0),
        (dict(lenslet_array__fill_factor=0.8), 0.64),
        (dict(main_lens__aperture_shape="square"), 1.0),
    ],
)
def test_all_light_of_the_object_reaches_the_sensor(model, changes, share):
    camera = small_camera(**changes)
    total = uniform_response(camera, WAVELENGTH, model)[0].sum()
    assert total == pytest.approx(
        share,
        abs=1e-9 if model == "ray" and not changes.get("lenslet_array__fill_factor") else 5e-3,
    )
    assert model == "ray" or total < share  # what diffraction sends further than TAIL pitches


def test_a_window_one_pixel_further_holds_the_same_pixels():
    camera = small_camera(main_lens__aperture_shape="square", filter_array=FILTERS)
    for model in ("ray", "fresnel"):
        still, moved = uniform_response(
            camera, WAVELENGTH, model, [(0.25, 0.0), (1.25, -1.0)]
        ).reshape(2, 13, 13)
        np.testing.assert_allclose(moved[:-1, 1:], still[1:, :-1], atol=1e-9)


def test_glasses_act_through_the_lenslets_alone():
    plain = small_camera(light__design_wavelength=550e-9)
    singlet = small_camera(light__design_wavelength=550e-9, main_lens__glass="N-BK7")
    lenslets = small_camera(light__design_wavelength=550e-9, lenslet_array__glass="N-SF11")
    for model in ("ray", "fresnel"):
        even = uniform_response(plain, 450e-9, model)
        np.testing.assert_array_equal(uniform_response(singlet, 450e-9, model), even)
        assert np.abs(uniform_response(lenslets, 450e-9, model) - even).max() > 0.001 * even.max()
    # lenslets a quarter as wide as the prototype's
    assert own_light(plain, 450e-9) == 1 and own_light(singlet, 450e-9) < 0.5


def test_share_of_a_lenslets_own_field():
    camera = small_camera(
        main_lens__aperture_shape="square", object__samples_per_lenslet=(24, 24), **BLURRED
    )
    blur = geometry(camera, WAVELENGTH).blur / geometry(camera, WAVELENGTH).D2
    assert 0.3 < blur < 2.5
    # of 1 - |x| where positive, x even over +-blur/2
    mean = 1 - blur / 4 if blur <= 2 else 1 / blur
    assert own_light(camera, WAVELENGTH) == pytest.approx(mean**2, rel=1e-3)
    blocks = field_response(
        pif_builder(camera, WAVELENGTH, model="ray", accuracy=0.5, superpixels=(5, 5))
    )
    assert blocks[12].sum() / blocks.sum() == pytest.approx(mean**2, rel=0.01)


def test_what_has_no_closed_form_is_said():
    assert valid_for(small_camera(), "fresnel") is None
    assert "circle lenslet" in valid_for(
        small_camera(lenslet_array__aperture_shape="circle"), "fresnel"
    )
    assert valid_for(small_camera(lenslet_array__aperture_shape="circle"), "ray") is None
