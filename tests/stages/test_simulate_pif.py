"""simulate-pif from a camera file to an artefact, through the command line."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.device import CPU, Device
from plenocli.cli.main import run
from plenocli.files.artefacts.reading import read_artefact
from plenocli.forward.propagation import system_matrix
from plenocli.forward.propagation.exact import lenslets
from tests.peak import PEAK
from tests.test_architecture import HEAVY

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "sample_configs" / "tiny.toml"


def test_artefact_summary_and_bytes(tmp_path, capsys):
    out, again = tmp_path / "pif.h5", tmp_path / "again.h5"
    assert (
        run(
            [
                "simulate-pif",
                str(TINY),
                "-o",
                str(out),
                "--model",
                "fresnel",
                "--accuracy",
                "1e-4",
                "--json",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert (
        run(
            [
                "simulate-pif",
                str(TINY),
                "-o",
                str(again),
                "--model",
                "fresnel",
                "--accuracy",
                "1e-4",
            ]
        )
        == 0
    )
    assert out.read_bytes() == again.read_bytes()
    artefact = read_artefact(out, "pif")
    A, offsets = artefact.data["pif/A"], artefact.data["pif/lenslet_offset"]
    assert A.shape == (1, 9, 169, 64) and A.dtype == np.float32 and [0, 0] in offsets.tolist()
    assert report["superpixels"] == [3, 3] and report["rank"] == list(
        np.atleast_1d(artefact.attrs["pif"]["rank"])
    )
    assert artefact.data["pif/column_energy"] == pytest.approx(
        A.sum(axis=(1, 2), dtype=float), rel=1e-6
    )
    assert artefact.data["pif/singular_values"].shape == (1, 64)
    assert "pif" in artefact.provenance.command and artefact.provenance.accuracy["asked"] == 1e-4


def test_the_diagnosis_stays_on_one_thread(tmp_path, monkeypatch):
    # two threads that wait for each other cost a fifth of the command, and round singular values as
    # the machine's cores have it
    import threadpoolctl

    from plenocli.forward.propagation.diagnosis import Spectrum

    seen, values = [], Spectrum.values
    monkeypatch.setattr(
        Spectrum,
        "values",
        lambda self: seen.append(threadpoolctl.threadpool_info()) or values(self),
    )
    with threadpoolctl.threadpool_limits(4, "blas"):
        camera = tmp_path / "many.toml"
        camera.write_text(
            TINY.read_text().replace(
                "samples_per_lenslet = [8, 8]", "samples_per_lenslet = [21, 21]"
            )
        )
        assert (
            run(
                [
                    "simulate-pif",
                    str(camera),
                    "-o",
                    str(tmp_path / "pif.h5"),
                    "--model",
                    "fresnel",
                    "--accuracy",
                    "1e-3",
                ]
            )
            == 0
        )
    assert seen and all(
        library["num_threads"] == 1
        for info in seen
        for library in info
        if library["user_api"] == "blas"
    )


def test_options_reach_the_matrix(tmp_path, capsys):
    out = tmp_path / "pif.h5"
    code = run(
        [
            "simulate-pif",
            str(TINY),
            "-o",
            str(out),
            "--wavelength",
            "650nm",
            "--wavelength",
            "450nm",
            "--superpixels",
            "1x1",
            "--coherent-ring",
            "0",
            "--dtype",
            "float64",
            "--accuracy",
            "1e-3",
            "--model",
            "fresnel",
        ]
    )
    assert code == 0
    artefact = read_artefact(out, "pif")
    assert (
        artefact.data["pif/A"].shape == (2, 1, 169, 64)
        and artefact.data["pif/A"].dtype == np.float64
    )
    assert (
        artefact.data["pif/wavelength"].tolist() == [450e-9, 650e-9]
        and artefact.attrs["pif"]["coherent_ring"] == 0
    )
    assert "2 band(s)" in capsys.readouterr().out


def test_explain_writes_nothing(tmp_path, capsys):
    assert run(["simulate-pif", str(TINY), "--explain"]) == 0
    assert "nodes across a lenslet" in capsys.readouterr().out and not list(tmp_path.iterdir())


def test_warns_where_half_of_the_object_is_invisible(tmp_path, capsys):
    camera = tmp_path / "conjugate.toml"
    # f2 z2/(z2 - f2): the lenslets image the pupil onto the sensor
    camera.write_text(
        TINY.read_text().replace(
            '[sensor]\ndistance = "208 um"', '[sensor]\ndistance = "208.789605430890 um"'
        )
    )
    assert (
        run(
            [
                "simulate-pif",
                str(camera),
                "-o",
                str(tmp_path / "pif.h5"),
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "--coherent-ring",
                "0",
            ]
        )
        == 0
    )
    assert "half of the object is invisible" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, code, words",
    [
        (["--model", "wrong", "-o", "x.h5"], 2, "auto"),
        ([], 2, "no output file"),
        (["-o", "x.h5", "--superpixels", "2x2"], 2, "odd"),
        (["-o", "x.h5", "--accuracy", "1e-13"], 5, "cannot be reached"),
        (["-o", "x.h5", "--mem-limit", "1MiB"], 5, "--mem-limit"),
        (["-o", "x.h5", "--wavelength", "550"], 2, "unit"),
        (["-o", "missing/x.h5"], 4, "missing"),
    ],
    ids=str,
)
def test_refusals(tmp_path, monkeypatch, capsys, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    assert run(["simulate-pif", str(TINY), *arguments]) == code
    assert words in capsys.readouterr().err


def test_existing_output_and_unreadable_camera(tmp_path, capsys):
    out = tmp_path / "pif.h5"
    out.write_text("mine")
    assert run(["simulate-pif", str(TINY), "-o", str(out)]) == 2 and out.read_text() == "mine"
    assert run(["simulate-pif", str(tmp_path / "none.toml"), "-o", str(tmp_path / "new.h5")]) == 3
    capsys.readouterr()


def test_spectral_step_gives_the_wavelengths_of_white_light(tmp_path):
    camera = ROOT / "sample_configs" / "demo_spectral.toml"
    out = tmp_path / "pif.h5"
    assert (
        run(
            [
                "simulate-pif",
                str(camera),
                "-o",
                str(out),
                "--spectral-step",
                "50nm",
                "--superpixels",
                "1x1",
                "--accuracy",
                "1e-2",
                "--model",
                "fresnel",
            ]
        )
        == 0
    )
    assert read_artefact(out, "pif").data["pif/wavelength"] == pytest.approx(
        np.arange(400e-9, 701e-9, 50e-9)
    )


def test_an_off_axis_lenslet_on_the_sensors_raster(tmp_path, capsys):
    camera, out, centred = tmp_path / "drift.toml", tmp_path / "pif.h5", tmp_path / "centred.h5"
    camera.write_text(
        TINY.read_text().replace('superpixel_pitch = "26 um"', 'superpixel_pitch = "26.3 um"')
    )
    common = [
        "--model",
        "fresnel",
        "--accuracy",
        "1e-4",
        "--superpixels",
        "1x1",
        "--coherent-ring",
        "0",
    ]
    assert run(["simulate-pif", str(camera), "-o", str(out), "--lenslet", "0,1", *common]) == 0
    assert run(["simulate-pif", str(camera), "-o", str(centred), *common]) == 0
    artefact = read_artefact(out, "pif")
    notes, count = (
        artefact.attrs["pif"]["notes"],
        read_artefact(out, "pif").provenance.config.count("count"),
    )
    assert notes["lenslet"] == [0, 1] and count == 1
    # off by 0.15 pixel a lenslet from the middle one; the light is where the shifted window sees
    # it, but for what it cuts off
    shift = np.array(notes["pixel_shift"])
    rows, columns = 13, 13
    image, plain = (
        read_artefact(p, "pif").data["pif/A"][0, 0].sum(axis=1).reshape(rows, columns)
        for p in (out, centred)
    )
    centroid = lambda a: (
        np.array([np.arange(rows) @ a.sum(axis=1), np.arange(columns) @ a.sum(axis=0)]) / a.sum()
    )
    assert (
        centroid(image) - centroid(plain) == pytest.approx(-shift, abs=0.08)
        and np.abs(shift).max() > 0.25
    )
    assert run(["simulate-pif", str(TINY), "--explain", "--lenslet", "9,9"]) == 2
    assert "is not on the array" in capsys.readouterr().err


def test_pieces_and_shards_hold_what_the_whole_does(tmp_path, monkeypatch, capsys):
    """The same bytes whether A is held or streamed and for any number of threads; shards
    together are the whole.
    """
    from plenocli.files.artefacts import pif_pieces
    from plenocli.files.artefacts.shards import read_pif

    def matrix(name, *options):
        assert (
            run(
                [
                    "simulate-pif",
                    str(TINY),
                    "-o",
                    str(tmp_path / name),
                    "--superpixels",
                    "3x3",
                    "--model",
                    "fresnel",
                    "--accuracy",
                    "1e-4",
                    *options,
                ]
            )
            == 0
        )
        return tmp_path / name

    whole = matrix("whole.h5")
    assert matrix("threads.h5", "--workers", "3").read_bytes() == whole.read_bytes()
    monkeypatch.setattr(pif_pieces, "layout", lambda *a: pif_pieces.Layout(True))
    assert abs(matrix("pieces.h5").stat().st_size - whole.stat().st_size) < 4096
    streamed, held = read_artefact(tmp_path / "pieces.h5", "pif"), read_artefact(whole, "pif")
    assert np.array_equal(streamed.data["pif/A"], held.data["pif/A"])
    # few points: the whole goes through LAPACK, pieces through A^T A
    assert streamed.data["pif/singular_values"][0, :40] == pytest.approx(
        held.data["pif/singular_values"][0, :40], rel=1e-6
    )
    monkeypatch.setattr(
        pif_pieces, "layout", lambda *a: pif_pieces.Layout(True, ((0, 1, 2, 3), (4, 5, 6, 7), (8,)))
    )
    sharded = read_pif(matrix("shards.h5"))
    assert len(list(tmp_path.glob("shards.00?.h5"))) == 3
    assert np.array_equal(sharded.data["pif/A"], held.data["pif/A"]) and np.array_equal(
        sharded.data["pif/lenslet_offset"], held.data["pif/lenslet_offset"]
    )
    assert sharded.data["pif/column_energy"] == pytest.approx(
        held.data["pif/column_energy"], rel=1e-12
    )
    capsys.readouterr()


def test_layouts_follow_the_memory_limit():
    from types import SimpleNamespace

    from plenocli.files.artefacts.pif_pieces import Layout, layout

    def plan(superpixels, bands=1):
        size = bands * superpixels * 2704 * 1600 * 4
        return SimpleNamespace(
            shape=(bands, superpixels, 2704, 1600),
            bytes=size,
            memory=size + (64 << 20),
            at_once=1,
        )

    with within(Budget(512 << 20)):
        assert layout(plan(1), "x") == Layout(False)
        assert layout(plan(9), "x") == Layout(True)
        sharded = layout(plan(25), "x").groups
    assert [n for group in sharded for n in group] == list(range(25)) and max(
        map(len, sharded)
    ) * 17 < 64
    with within(Budget(8 << 30)):
        assert layout(plan(25), "x") == Layout(True)


@pytest.mark.slow
@pytest.mark.parametrize("superpixels", ["3x3", "5x5"])
def test_memory_limit_is_kept(tmp_path, superpixels):
    """Peak of the whole command, measured in a child: below the limit, libraries included."""
    camera = ROOT / "sample_configs" / "seed_spatial_250um.toml"
    code = (
        "import sys; from plenocli.cli.main import run; assert run(sys.argv[1:]) == 0\n"
        f"print('PEAK', {PEAK})"
    )
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            code,
            "simulate-pif",
            str(camera),
            "--superpixels",
            superpixels,
            "--coherent-ring",
            "1",
            "--model",
            "fresnel",
            "--accuracy",
            "1e-2",
            "--mem-limit",
            "512MiB",
            "-o",
            str(tmp_path / "pif.h5"),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout.split("PEAK")[1]) < 512 * 1024
    assert (len(list(tmp_path.glob("pif.*.h5"))) > 1) == (superpixels == "5x5")


@pytest.mark.parametrize(
    "was, wrong, meant",
    [
        ('focal_length = "50 mm"', 'focal_length = "1 nm"', "main_lens.focal_length is 1 nm"),
        ('"26 um"', '"55 nm"', "superpixel_pitch is 55 nm: was 55 um meant?"),
        ('distance = "55 mm"', 'distance = "55 m"', "is 55 m: was 55 mm meant?"),
    ],
)
def test_lengths_that_belong_to_no_camera_are_refused_alike(tmp_path, capsys, was, wrong, meant):
    """Before anything is planned, with the length that is wrong, in the plan and in the run."""
    camera, output = tmp_path / "camera.toml", tmp_path / "pif.h5"
    camera.write_text(TINY.read_text().replace(was, wrong))
    told = []
    for more in (["--explain"], ["-o", str(output)]):
        assert run(["simulate-pif", str(camera), *more]) == 2
        told.append(capsys.readouterr().err)
    assert told[0] == told[1] and meant in told[0] and not output.exists()


def test_a_plan_that_would_be_refused_says_so(capsys):
    command = ["simulate-pif", str(TINY), "--superpixels", "41x41", "--explain"]
    assert run([*command, "--coherent-ring", "1", "--mem-limit", "64MiB"]) == 0
    assert "! would be refused" in capsys.readouterr().out


def test_a_matrix_without_light_is_not_written(tmp_path, capsys, monkeypatch):
    from plenocli.stages.forward import simulate_pif

    monkeypatch.setattr(simulate_pif, "DARK", 2.0)  # no point has so much light
    output = tmp_path / "pif.h5"
    assert run(["simulate-pif", str(TINY), "--accuracy", "0.1", "-o", str(output)]) == 5
    assert "of any point's light lands" in capsys.readouterr().err and not output.exists()


def scene(folder, near, far):
    path = folder / "scene.toml"
    path.write_text(f'depth = ["{near}", "{far}"]\n')
    return str(path)


def test_a_scene_with_depth_is_stored_as_planes_between_which_one_interpolates(tmp_path, capsys):
    """capture-sim at a distance between the planes records what a camera focused there records."""
    index, depth = tmp_path / "stack.h5", scene(tmp_path, "540 mm", "560 mm")
    command = ["simulate-pif", str(TINY), "--scene", depth, "--accuracy", "0.02", "--json"]
    model = ["--model", "fresnel", "--superpixels", "3x3"]
    assert run([*command, *model, "--explain"]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert run([*command, *model, "-o", str(index)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["distances"] == [plane["distance"] for plane in planned["planes"]]
    assert report["distances"][0] == 0.54 and report["distances"][-1] == 0.56
    assert 0 < report["interpolation_error"] <= 0.01
    sizes = [read_artefact(p, "pif").data["pif/A"].nbytes for p in tmp_path.glob("stack.0*.h5")]
    assert len(sizes) == len(report["distances"]) and sum(sizes) == planned["bytes"]
    assert 0.02 > report["planes"][0]["estimated_accuracy"] > report["interpolation_error"]

    between = tmp_path / "between.toml"
    between.write_text(TINY.read_text().replace("550 mm", "543 mm"))
    capture = ["capture-sim", str(between), "--scene", "skimage:coffee", "--snr", "200dB"]
    assert run([*capture, "--pif", str(index), "-o", str(tmp_path / "a.h5")]) == 0
    capture += ["--model", "fresnel", "--superpixels", "3x3", "--accuracy", "1e-4"]
    assert run([*capture, "-o", str(tmp_path / "b.h5")]) == 0
    mixed, own = (
        read_artefact(tmp_path / name, "capture").data["capture/mosaic"]
        for name in ("a.h5", "b.h5")
    )
    assert 1e-6 < np.linalg.norm(mixed - own) / np.linalg.norm(own) < 0.02

    capsys.readouterr()
    assert run(["reconstruct", "a.h5", "--pif", str(index), "-o", "c.h5"]) == 3
    (tmp_path / "stack.001.h5").write_bytes((tmp_path / "stack.002.h5").read_bytes())
    assert run([*capture[:6], "--pif", str(index), "-o", str(tmp_path / "d.h5")]) == 3
    assert "is not the file that stack.h5 was written with" in capsys.readouterr().err


def test_a_scene_in_one_plane_costs_one_matrix_at_its_distance(tmp_path, capsys):
    """And no more superpixels than the blur of that plane needs."""
    output = tmp_path / "pif.h5"
    command = ["simulate-pif", str(TINY), "--accuracy", "0.05", "--json", "-o", str(output)]
    assert run([*command, "--scene", scene(tmp_path, "540 mm", "540 mm")]) == 0
    one = json.loads(capsys.readouterr().out)
    own = tmp_path / "own.toml"
    own.write_text(TINY.read_text().replace("550 mm", "540 mm"))
    command[1], command[-1] = str(own), str(tmp_path / "own.h5")
    assert run(command) == 0
    assert one["superpixels"] == json.loads(capsys.readouterr().out)["superpixels"] == [3, 3]
    assert sorted(p.name for p in tmp_path.glob("*.h5")) == ["own.h5", "pif.h5"]
    stored, focused = (read_artefact(tmp_path / n, "pif") for n in ("pif.h5", "own.h5"))
    assert np.array_equal(stored.data["pif/A"], focused.data["pif/A"])
    assert stored.provenance.config == focused.provenance.config


def test_planes_that_fail_leave_no_file(tmp_path, capsys, monkeypatch):
    from plenocli.files.artefacts import shards

    def full(*args, **options):
        raise OSError(28, "No space left on device", "stack.h5")

    monkeypatch.setattr(shards, "write_planes", full)
    depth = scene(tmp_path, "548 mm", "552 mm")
    command = ["simulate-pif", str(TINY), "--scene", depth, "--accuracy", "0.1"]
    assert run([*command, "--model", "ray", "-o", str(tmp_path / "stack.h5")]) == 4
    assert not list(tmp_path.glob("*.h5"))


SHARED = {"numpy", "pydantic", "h5py", "tqdm"}
"""Of what is heavy, what any matrix takes."""
RARE = (
    *("plenocli.files.config.lens_file", "plenocli.files.config.curve_file"),
    *("plenocli.files.config.microscope_file", "plenocli.files.read.scenes"),
    *("plenocli.files.images", "plenocli.files.outside"),
    *("plenocli.forward.accuracy.depth_planes", "plenocli.forward.accuracy.field_nodes"),
    *("plenocli.forward.camera.glass", "plenocli.forward.camera.lens"),
    *("plenocli.forward.camera.raytrace", "plenocli.forward.camera.microscope"),
    *("plenocli.forward.propagation.exact", "plenocli.forward.propagation.harmonics"),
    *("plenocli.forward.propagation.ray", "plenocli.forward.volume"),
)
"""What a paraxial matrix of a plain camera has no use for, each with all that is in it."""


@pytest.mark.parametrize("more, shared", [([], SHARED), (["--explain"], SHARED - {"h5py"})])
def test_a_matrix_is_computed_without_what_it_does_not_use(tmp_path, more, shared):
    arguments = ["simulate-pif", str(ROOT / "sample_configs" / "seed_spatial.toml"), *more]
    arguments += ["--superpixels", "1x1", "--coherent-ring", "0", "--model", "fresnel"]
    unused = (*sorted({*HEAVY, "numpy.f2py"} - shared), *RARE)
    code = (
        "import sys; from plenocli.cli.main import run\n"
        f"assert run({[*arguments, '-o', str(tmp_path / 'pif.h5')]!r}) == 0\n"
        f"unused = tuple(name + '.' for name in {unused!r})\n"
        "print('UNUSED', [name for name in sys.modules if f'{name}.'.startswith(unused)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "UNUSED []"


def test_an_exact_matrix_by_another_library_is_told(tmp_path, monkeypatch, capsys):
    library = pytest.importorskip("array_api_strict")
    another = lambda name: Device("another", library) if name == "cuda" else CPU
    for module in (lenslets, system_matrix):
        monkeypatch.setattr(module, "device", another)
    exact = ["simulate-pif", str(TINY), "--model", "exact", "--superpixels", "1x3"]
    found = []
    for name in ("cpu", "cuda"):
        path = tmp_path / f"{name}.h5"
        assert run([*exact, "--accuracy", "1e-2", "--device", name, "-o", str(path)]) == 0
        found.append(read_artefact(path))
    one, two = (artefact.data["pif/A"] for artefact in found)
    energy = np.sqrt(np.sum(one.astype(float) ** 2, axis=(1, 2)))
    assert (np.sqrt(np.sum((one - two).astype(float) ** 2, axis=(1, 2))) < 1e-5 * energy).all()
    assert [a.attrs["pif"]["notes"].get("device") for a in found] == [None, "another"]
    capsys.readouterr()
    rays = ["simulate-pif", str(TINY), "--model", "fresnel", "--device", "cuda"]
    assert run([*rays, "-o", str(tmp_path / "paraxial.h5")]) == 0
    assert "computed on the processor" in capsys.readouterr().err
