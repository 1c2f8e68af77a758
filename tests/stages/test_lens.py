"""lens files, `lens show`, `lens import`, and a real lens in a camera."""

import json
import math
import sys
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, InputError
from plenocli.cli.main import run
from plenocli.files.config.lens_file import lens_toml, load_lens, parse_lens
from plenocli.forward.camera.field import at_field
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.glass import medium
from plenocli.forward.camera.lens import first_order
from plenocli.forward.camera.prescription import Prescription, Surface
from plenocli.forward.camera.pupil import wavefront
from plenocli.forward.camera.raytrace import Rays, entrance_pupil
from tests.forward.camera.lenses import D_LINE, triplet
from tests.forward.propagation.cameras import small_camera

TEXT = """
[lens]
name = "plano-convex"
stop = 1
stop_diameter = "10 mm"
[[surface]]
radius = "25.84 mm"
thickness = "4 mm"
glass = "mine"
conic = -0.6
asphere = { r4 = "1e-6 mm^-3", r8 = "2.5e-13 mm^-7" }
semi_diameter = "6 mm"
[[surface]]
radius = "flat"
[glass.mine]
sellmeier = [[1.03961212, 0.00600069867], [0.231792344, 0.0200179144], [1.01046945, 103.560653]]
range = ["300 nm", "2.5 um"]
"""


# --- the file -------------------------------------------------------------------------------------


def test_a_lens_file_in_si():
    lens = parse_lens(TEXT)
    first, last = lens.surfaces
    assert (1 / first.curvature, first.thickness, first.conic, first.semi_diameter) == (
        25.84e-3,
        4e-3,
        -0.6,
        6e-3,
    )
    assert (
        first.asphere == (0.0, 1e3, 0.0, 2.5e8)
        and last.curvature == 0
        and last.semi_diameter == math.inf
    )
    assert (
        first.medium.index(D_LINE) == pytest.approx(1.5168, abs=2e-5)
        and last.medium.index(D_LINE) == 1
    )
    assert (
        lens.stop == 0
        and lens.stop_radius == 5e-3
        and lens.object_distance == math.inf
        and lens.design_wavelength == D_LINE
    )


@pytest.mark.parametrize(
    "lens",
    [
        triplet(),
        parse_lens(TEXT),
        replace(
            triplet().scaled(1 / 3),
            object_distance=0.25,
            name='a "name" \\ of\nlines'.replace("\n", " "),
        ),
    ],
)
def test_written_lenses_are_read_back_to_the_last_bit(lens):
    assert parse_lens(lens_toml(lens)) == lens


def test_every_violation_at_once():
    bad = (
        TEXT.replace('"25.84 mm"', "25.84")
        .replace('"4 mm"', '"4 mmm"')
        .replace("r8 =", "r7 =")
        .replace("conic", "cnic")
        .replace('stop_diameter = "10 mm"\n', "")
    )
    with pytest.raises(ConfigError) as caught:
        parse_lens(bad, "x.toml")
    text = str(caught.value)
    for part in (
        "x.toml",
        "5 violations",
        "surface.0.radius",
        "surface.0.thickness",
        "'r7' is no even power",
        "did you mean conic?",
        "lens.stop_diameter: is missing",
    ):
        assert part in text, (part, text)


@pytest.mark.parametrize(
    "change, message",
    [
        (("stop = 1", "stop = 3"), "there are 2 surfaces"),
        (
            ('glass = "mine"', 'glass = "unobtainium"'),
            r"surface 1: 'unobtainium' is not a known glass",
        ),
        (('r4 = "1e-6 mm^-3"', 'r4 = "1e-6 mm^-4"'), "power 3"),
        (('radius = "flat"', 'radius = "flat"\nglass = "N-BK7"'), "end in air"),
        (('"300 nm", "2.5 um"', '"700 nm", "2.5 um"'), "described from 0.7"),
        (("range", "nd = 1.5\nrange"), "exactly one of sellmeier"),
        (("25.84 mm", "0 mm"), "is no radius"),
    ],
)
def test_what_a_lens_file_may_not_say(change, message):
    with pytest.raises(ConfigError, match=message):
        parse_lens(TEXT.replace(*change))


# --- show -----------------------------------------------------------------------------------------


def test_show_prints_the_first_order_data_and_the_fields(tmp_path, capfd):
    file = tmp_path / "triplet.toml"
    file.write_text(lens_toml(triplet()))
    arguments = [
        "lens",
        "show",
        str(file),
        "--wavelength",
        "450nm",
        "--wavelength",
        "650nm",
        "--field",
        "0deg",
        "--field",
        "0.2rad",
    ]
    assert run([*arguments, "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert [w["wavelength_m"] for w in report["wavelengths"]] == [450e-9, 650e-9]
    assert report["wavelengths"][0]["focal_length_m"] == pytest.approx(
        first_order(triplet(), 450e-9).focal_length
    )
    axis, edge = report["fields"]
    assert (
        axis["distortion"] == 0
        and axis["transmitted"] == 1
        and edge["wavelengths"][0]["image_height_m"]
        == pytest.approx(50e-3 * math.tan(0.2), rel=0.02)
    )
    # W over the unit disc is the sum of its orthonormal terms
    for row in axis["wavelengths"]:
        assert math.sqrt(
            sum(c * c for c in row["noll_m"][1:]) + row["noll_rest_m"] ** 2
        ) == pytest.approx(row["wavefront_rms_m"], rel=1e-3)
    assert run(arguments) == 0
    text = capfd.readouterr().out
    assert "450.00 nm" in text and "field 11.46 deg" in text and "lateral colour" in text


def test_show_says_where_a_field_does_not_get_through_and_refuses_what_it_cannot_read(
    tmp_path, capfd
):
    file = tmp_path / "triplet.toml"
    file.write_text(lens_toml(triplet()))
    assert run(["lens", "show", str(file), "--field", "80deg"]) == 0
    assert "reaches the centre of the stop" in capfd.readouterr().out
    assert run(["lens", "show", str(tmp_path / "none.toml")]) == 3
    assert run(["lens", "show", str(file), "--field", "12"]) == 2
    assert "such as 5deg" in capfd.readouterr().err
    file.write_text("[lens]\n")
    assert run(["lens", "show", str(file)]) == 2


def test_a_telecentric_lens_has_no_f_number(tmp_path, capfd):
    """A stop in the rear focus: the entrance pupil lies at infinity, and no quotient with its
    diameter means anything.
    """
    file = tmp_path / "telecentric.toml"
    n = medium("N-BK7").index(D_LINE)
    file.write_text(
        lens_toml(
            Prescription(
                surfaces=(
                    Surface(curvature=100.0, thickness=2e-3, medium=medium("N-BK7")),
                    Surface(curvature=0.0, thickness=0.01 / (n - 1) - 2e-3 / n),
                    Surface(curvature=0.0, thickness=5e-3),
                ),
                stop=2,
                stop_radius=1e-3,
                design_wavelength=D_LINE,
            )
        )
    )
    assert run(["lens", "show", str(file), "--wavelength", "587.5618nm"]) == 0
    line = capfd.readouterr().out.splitlines()[3]
    assert line.split("um")[1].split()[:3] == ["-", "at", "infinity"]
    assert run(["lens", "show", str(file), "--wavelength", "587.5618nm", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["wavelengths"][0]["f_number"] is None


# --- in a camera ----------------------------------------------------------------------------------


def camera_with_triplet(**changes):
    camera = small_camera(
        main_lens__prescription="triplet.toml", light__design_wavelength=550e-9, **changes
    )
    return camera.attach(prescription=triplet())


def test_a_camera_takes_focal_shift_and_wavefront_from_its_lens_file():
    camera = camera_with_triplet()
    design = geometry(camera, 550e-9).f1
    assert design == pytest.approx(first_order(triplet(), 550e-9).focal_length, rel=1e-3)
    red = at_field(camera, 650e-9).main_lens
    assert red.focal_length == geometry(camera, 650e-9).f1 != design
    assert {a.noll for a in red.aberrations} == {4, 11, 22, 37, 56}
    rim = camera.main_lens.aperture_diameter / 2
    assert (
        abs(
            wavefront(red, np.array(0.0), np.array(rim))
            - wavefront(red, np.array(0.0), np.array(0.0))
        )
        > 1e-9
    )
    with pytest.raises(RuntimeError, match="without a wavelength"):
        wavefront(camera.main_lens, np.array(0.0), np.array(0.0))


def test_the_system_matrix_is_that_of_the_thin_camera_which_the_rays_give(tmp_path):
    """simulate-pif on a camera with a lens file equals simulate-pif on one whose focal length
    and Noll terms are spelled out.
    """
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.config.camera_file import to_toml

    camera = camera_with_triplet(light__wavelengths=[450e-9], main_lens__aperture_diameter=4e-3)
    resolved = at_field(camera, 450e-9)
    plain = camera_with_triplet(
        light__wavelengths=[450e-9], main_lens__aperture_diameter=4e-3
    ).main_lens.model_copy(update={"prescription": None})
    (tmp_path / "triplet.toml").write_text(lens_toml(triplet()))
    matrices = []
    for name, described in (
        ("lens", camera),
        ("thin", resolved),
        ("without", camera.model_copy(update={"main_lens": plain})),
    ):
        (tmp_path / f"{name}.toml").write_text(to_toml(described))
        assert (
            run(
                [
                    "simulate-pif",
                    str(tmp_path / f"{name}.toml"),
                    "-o",
                    str(tmp_path / f"{name}.h5"),
                    "--superpixels",
                    "1x1",
                    "--dtype",
                    "float64",
                ]
            )
            == 0
        )
        matrices.append(read_artefact(tmp_path / f"{name}.h5").data["pif/A"])
    assert matrices[0] == pytest.approx(matrices[1], abs=1e-12 * matrices[1].max())
    assert np.abs(matrices[0] - matrices[2]).max() > 1e-3 * matrices[2].max()
    assert set(read_artefact(tmp_path / "lens.h5").provenance.inputs) >= {"camera", "prescription"}


def test_a_lens_file_of_another_focal_length_or_without_its_values_is_refused():
    with pytest.raises(ConfigError, match="lens import --focal-length"):
        geometry(camera_with_triplet().attach(prescription=triplet().scaled(1.1)), 550e-9)
    with pytest.raises(ConfigError, match="'triplet.toml' are missing"):
        geometry(small_camera(main_lens__prescription="triplet.toml"), 550e-9)
    with pytest.raises(ValueError, match="exclude each other"):
        small_camera(main_lens__prescription="triplet.toml", main_lens__glass="N-BK7")


# --- import ---------------------------------------------------------------------------------------

ZMX = """VERS 171115
MODE SEQ
NAME doublet
UNIT MM X W X CM MR CPMM
ENPD 10
GCAT SCHOTT
FTYP 0 0 2 1 0 0 0
XFLN 0 0
YFLN 0 5
WAVM 1 0.5875618 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
SURF 1
  STOP
  TYPE EVENASPH
  CURV 0.016
  PARM 1 0
  PARM 2 -1e-6
  DISZ 6
  GLAS N-BK7 0 0 1.5168 64.17
  CONI -0.5
SURF 2
  TYPE STANDARD
  CURV -0.022
  DISZ 2.5
  GLAS XYZ9 0 0 1.65 33.8
SURF 3
  TYPE STANDARD
  CURV -0.008
  DISZ 97
SURF 4
  TYPE STANDARD
  CURV 0
  DISZ 0
"""


def test_import_without_optiland_says_what_to_install(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "optiland", None)
    (tmp_path / "a.zmx").write_text(ZMX)
    assert run(["lens", "import", str(tmp_path / "a.zmx"), "-o", str(tmp_path / "a.toml")]) == 2
    assert (
        "pip install 'optiland>=" in capfd.readouterr().err and not (tmp_path / "a.toml").exists()
    )


def test_import_refuses_other_files(tmp_path, capfd):
    (tmp_path / "a.txt").write_text("x")
    assert run(["lens", "import", str(tmp_path / "a.txt"), "-o", str(tmp_path / "a.toml")]) == 2
    assert run(["lens", "import", str(tmp_path / "none.zmx"), "-o", str(tmp_path / "a.toml")]) == 3
    assert run(["lens", "import", str(tmp_path / "none.zmx"), "-o", str(tmp_path / "a.h5")]) == 2


def test_import_keeps_the_numbers_of_a_zemax_file(tmp_path, capfd):
    pytest.importorskip("optiland", reason="needs the extra [lens]")
    (tmp_path / "a.zmx").write_text(ZMX)
    assert run(["lens", "import", str(tmp_path / "a.zmx"), "-o", str(tmp_path / "a.toml")]) == 0
    out = capfd.readouterr().out
    assert "XYZ9 is in no catalogue" in out and "nd = 1.65, Vd = 33.8" in out
    lens = load_lens(tmp_path / "a.toml")
    assert [s.curvature for s in lens.surfaces] == pytest.approx([16.0, -22.0, -8.0]) and [
        s.thickness for s in lens.surfaces
    ] == pytest.approx([6e-3, 2.5e-3, 97e-3])
    assert lens.surfaces[0].conic == -0.5 and lens.surfaces[0].asphere == pytest.approx((0.0, -1e3))
    assert lens.surfaces[0].medium.coefficients[0] == (1.03961212, 0.00600069867)
    assert (
        lens.surfaces[1].medium.index(D_LINE) == pytest.approx(1.65)
        and lens.stop_radius == pytest.approx(5e-3)
        and lens.name == "doublet"
    )
    assert (
        run(
            [
                "lens",
                "import",
                str(tmp_path / "a.zmx"),
                "-o",
                str(tmp_path / "b.toml"),
                "--focal-length",
                "50mm",
            ]
        )
        == 0
    )
    assert first_order(load_lens(tmp_path / "b.toml"), D_LINE).focal_length == pytest.approx(50e-3)
    (tmp_path / "bad.zmx").write_text("rubbish")
    assert run(["lens", "import", str(tmp_path / "bad.zmx"), "-o", str(tmp_path / "c.toml")]) == 3
    assert tomllib.loads((tmp_path / "a.toml").read_text())["glass"]["XYZ9"]["nd"] == 1.65


FILES = ["lens1.zmx", "lens2.zmx", "Cooke_triplet.json", "heliar.json", "reverse_telephoto.json"]


@pytest.mark.parametrize("name", FILES)
def test_rays_wavefront_and_focal_shift_are_optiland_s(shared_data, name):
    """OPD within 1e-6 waves on and off axis and focal shift within 0.1 um, for rays that both
    launch at the paraxial entrance pupil.
    """
    pytest.importorskip("optiland", reason="needs the extra [lens]")
    import warnings

    from optiland.wavefront import Wavefront as Theirs

    from plenocli.files.config import prescription_file
    from plenocli.forward.camera import lens as ours

    path = shared_data / "lens" / "optiland" / name
    found, _ = prescription_file.import_lens(path)
    lens = parse_lens(lens_toml(found))  # through the file
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optic, _ = prescription_file._read(path)
        top = max(field.y for field in optic.fields.fields)
        index = {w: float(np.ravel(optic.surfaces.n(w))[0]) for w in (0.45, 0.55, 0.65)}
        assert set(index.values()) == {1.0}
        for microns in (0.45, 0.55, 0.65):
            for share in (0.0, 0.7, 1.0) if top else (0.0,):
                theirs = Theirs(
                    optic,
                    fields=[(0, share)],
                    wavelengths=[microns],
                    num_rays=16,
                    distribution="uniform",
                )
                data = next(iter(theirs.data.values()))
                points = np.stack(
                    [np.ravel(theirs.distribution.x), np.ravel(theirs.distribution.y)]
                )
                wave = _paraxially_aimed(
                    ours, lens, microns * 1e-6, points, math.radians(top * share)
                )
                lit = np.isfinite(wave.error) & (np.ravel(data.intensity) > 0)
                assert lit.mean() > 0.7
                assert np.abs(-wave.error / (microns * 1e-6) - np.ravel(data.opd))[lit].max() < 1e-6
                assert wave.centre[1] * 1e3 == pytest.approx(
                    float(data.reference_center[1]), abs=1e-9
                )
        shifts = [
            _back_focus(optic, w) - _back_focus(optic, optic.primary_wavelength)
            for w in (0.45, 0.65)
        ]
    assert ours.focal_shift(lens, [450e-9, 650e-9]) == pytest.approx(
        np.array(shifts) * 1e-3, abs=1e-12
    )


def _back_focus(optic, microns):
    y, u = optic.paraxial.trace_generic(1.0, 0.0, -1.0, microns)
    return -float(np.ravel(y[-2])[0]) / float(np.ravel(u[-2])[0])


def _paraxially_aimed(ours, lens, wavelength, points, angle):
    """Our Wavefront of the very rays that optiland launches by default: through its entrance
    pupil at the primary wavelength.
    """
    pupil = entrance_pupil(lens, lens.design_wavelength)

    def launch(_, __, chosen, *, angle, object_distance):
        at = np.stack(
            [*(np.asarray(chosen) * pupil.radius), np.full(np.shape(chosen)[1], pupil.position)]
        )
        direction = np.repeat([[0.0], [math.sin(angle)], [math.cos(angle)]], at.shape[1], axis=1)
        t = -at[2] / direction[2]
        return Rays(at + t * direction, direction, (direction[:2] * at[:2]).sum(axis=0) + t)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ours, "aim", launch)
        return ours.wavefront(lens, wavelength, points, angle)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"surfaces": []}, "no surface between"),
        ({"is_stop": False}, "has 0 stops"),
        ({"interaction_model": SimpleNamespace(is_reflective=True)}, "surface 1 is a mirror"),
        (
            {"geometry": SimpleNamespace(cs=SimpleNamespace(x=0, y=1, z=0, rx=0, ry=0, rz=0))},
            "of the kind SimpleNamespace",
        ),
        (
            {
                "geometry": type(
                    "Plane", (), {"cs": SimpleNamespace(x=0, y=1, z=0, rx=0, ry=0, rz=0)}
                )()
            },
            "tilted or off axis",
        ),
    ],
)
def test_import_says_which_surface_is_none_of_ours(tmp_path, monkeypatch, change, words):
    """As optiland's objects are, without it."""
    from plenocli.files.config import prescription_file

    straight = SimpleNamespace(x=0, y=0, z=0, rx=0, ry=0, rz=0)
    flat = type("Plane", (), {"cs": straight, "radius": math.inf})()
    plain = {
        "geometry": flat,
        "interaction_model": None,
        "is_stop": True,
        "aperture": None,
        "material_post": type("IdealMaterial", (), {"index": 1.0})(),
    }
    surfaces = [
        SimpleNamespace(**plain | {"is_stop": False}),
        SimpleNamespace(**plain | change),
        SimpleNamespace(**plain | {"is_stop": False}),
    ]
    monkeypatch.setattr(
        prescription_file,
        "_read",
        lambda path: (SimpleNamespace(surfaces=change.get("surfaces", surfaces)), []),
    )
    (tmp_path / "a.seq").write_text("x")
    with pytest.raises(InputError, match=words):
        prescription_file.import_lens(tmp_path / "a.seq")


def test_what_optiland_cannot_read_is_an_input_error(tmp_path, monkeypatch):
    from plenocli.files.config import prescription_file

    def load(path):
        raise IndexError("list index out of range")

    fileio = SimpleNamespace(load_zemax_file=load, load_codev_file=load, load_optiland_file=load)
    monkeypatch.setitem(sys.modules, "optiland", SimpleNamespace(fileio=fileio))
    (tmp_path / "a.zmx").write_text("x")
    with pytest.raises(InputError, match="a.zmx: optiland cannot read it .IndexError"):
        prescription_file.import_lens(tmp_path / "a.zmx")
