"""A run folder's manifest, edited files, and what vouches for them; coreutils and OpenSSH as the
second readers.
"""

import shutil
import subprocess

import h5py
import numpy as np
import pytest

from plenocli.base.errors import InputError, OutputError, UsageError
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.images.dng import write_dng
from plenocli.files.images.mosaic import read_capture
from plenocli.files.images.tiff_stack import read_tiff_volume, write_volume_tiff
from plenocli.files.manifest import NAME, SIGNATURE, read_manifest
from plenocli.stages.evaluation.seal import EDITED, run_seal
from plenocli.stages.evaluation.verify import run_verify
from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif
from tests.faults.conftest import SAMPLES

ODD_NAMES = [
    "plain.txt",
    "two words.h5",
    "back\\slash",
    "new\nline",
    "ret\rurn",
    "sub/é.bin",
    "empty",
]


@pytest.fixture
def run(tmp_path):
    root = tmp_path / "run"
    (root / "sub").mkdir(parents=True)
    for number, name in enumerate(ODD_NAMES):
        (root / name).write_bytes(b"" if name == "empty" else bytes([number]) * (number + 1))
    return root


def coreutils(root):
    if shutil.which("sha256sum") is None:
        pytest.skip("coreutils are not installed")
    done = subprocess.run(["sha256sum", "-c", "--strict", NAME], cwd=root, capture_output=True)
    return done.returncode


def test_coreutils_reads_what_seal_writes_and_the_other_way_round(run):
    assert run_seal(run).files == len(ODD_NAMES) == run_verify(run).files
    assert coreutils(run) == 0
    ours = read_manifest(run)
    assert sorted(ours) == sorted(ODD_NAMES)
    theirs = subprocess.run(
        ["sha256sum", "--", *ODD_NAMES], cwd=run, capture_output=True, check=True
    ).stdout
    (run / NAME).write_bytes(theirs)
    assert read_manifest(run) == ours
    (run / "plain.txt").write_bytes(b"\1")
    assert coreutils(run) == 1


def _without_line(path, name):
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if not line.endswith(name + b"\n")))


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda run: (run / "plain.txt").write_bytes(b"\1"), "plain.txt altered"),
        (lambda run: (run / "sub/é.bin").unlink(), "missing"),
        (lambda run: (run / "two words.h5").rename(run / "other"), "two words.h5 missing"),
        (lambda run: (run / "later").write_text("x"), "later not listed"),
        (lambda run: _without_line(run / NAME, b"plain.txt"), "plain.txt not listed"),
    ],
)
def test_what_was_altered_or_is_gone_is_named(run, change, told):
    run_seal(run)
    change(run)
    with pytest.raises(InputError, match=told):
        run_verify(run)
    assert any(
        line.startswith(told.split(" ")[0]) or told == "missing" for line in run_seal(run).changes
    )
    run_verify(run)


@pytest.mark.parametrize(
    "line", ["{}  ../other\n", "{}  /etc/passwd\n", "{} x\n", "{}  a\n{}  a\n", "", "{}  a"]
)
def test_a_manifest_that_is_none_is_refused(run, line):
    (run / NAME).write_text(line.replace("{}", 64 * "a"))
    with pytest.raises(InputError):
        run_verify(run)


def test_a_signature_holds_for_its_signer_and_manifest_only(run, tmp_path):
    if shutil.which("ssh-keygen") is None:
        pytest.skip("OpenSSH is not installed")
    keys = {}
    for name in ("ours", "other"):
        make = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / name)]
        subprocess.run(make, check=True)
        keys[name] = tmp_path / f"allowed-{name}"
        keys[name].write_text(f"{name}@lab {(tmp_path / f'{name}.pub').read_text()}")
    run_seal(run, key=tmp_path / "ours")
    assert run_verify(run, signers=keys["ours"]).signer == "ours@lab"
    with pytest.raises(InputError, match="not by an allowed signer"):
        run_verify(run, signers=keys["other"])
    with pytest.raises(UsageError, match="is signed"):
        run_seal(run)
    manifest, signature = (run / NAME).read_bytes(), (run / SIGNATURE).read_bytes()
    with pytest.raises(OutputError, match="cannot be signed"):
        run_seal(run, key=tmp_path / "allowed-ours")
    assert ((run / NAME).read_bytes(), (run / SIGNATURE).read_bytes()) == (manifest, signature)
    (run / "plain.txt").write_bytes(b"\1")
    (run / SIGNATURE).unlink()
    run_seal(run)
    (run / SIGNATURE).write_bytes(signature)
    with pytest.raises(InputError, match="altered after it was signed"):
        run_verify(run, signers=keys["ours"])


def test_an_edited_artefact_is_sealed_again_and_says_so(tmp_path):
    original, edited = tmp_path / "pif.h5", tmp_path / "edited.h5"
    run_simulate_pif(SAMPLES / "tiny.toml", original, Settings(accuracy=1e-1))
    shutil.copy(original, edited)
    with h5py.File(edited, "r+") as file:
        file["pif/A"][0, 0, 2, 3] += 0.25
    with pytest.raises(InputError, match="SHA-256"):
        run_verify(edited)
    sealed = run_seal(edited, was=original)
    assert len(sealed.changes) == 1 and sealed.changes[0].startswith("pif/A: 1 of ")
    before, after = read_artefact(original), read_artefact(edited)
    assert after.data["pif/A"][0, 0, 2, 3] == before.data["pif/A"][0, 0, 2, 3] + np.float32(0.25)
    assert EDITED in after.provenance.inputs and EDITED not in before.provenance.inputs
    assert run_seal(edited).changes == ()


def test_an_edit_that_breaks_the_rules_of_its_kind_is_not_sealed(tmp_path):
    path = tmp_path / "pif.h5"
    run_simulate_pif(SAMPLES / "tiny.toml", path, Settings(accuracy=1e-1))
    with h5py.File(path, "r+") as file:
        file["pif/A"][...] = np.nan
    content = path.read_bytes()
    with pytest.raises(InputError):
        run_seal(path)
    assert path.read_bytes() == content


def test_an_edited_dng_is_sealed_again(tmp_path):
    original, edited = tmp_path / "white.dng", tmp_path / "edited.dng"
    mosaic = np.random.default_rng(1).integers(100, 4000, (40, 50))
    notes = {"exposure_s": 0.01, "note": "as it was"}
    write_dng(original, mosaic, cfa="RGGB", black=64, white=4095, xmp_json=notes)
    content = original.read_bytes()
    edited.write_bytes(content.replace(b"as it was", b"as it is!"))
    with pytest.raises(InputError, match="not sealed"):
        read_capture(edited)
    assert run_seal(edited, was=original).changes == ("note: as it was -> as it is!",)
    assert np.array_equal(read_capture(edited).mosaic, mosaic)
    edited.write_bytes(content.replace(b"plenocli sha256", b"plenocli sha255"))
    with pytest.raises(InputError, match="no place for a digest"):
        run_seal(edited)


def test_a_volume_for_other_programs_is_sealed_and_the_same_each_time(tmp_path):
    paths = [tmp_path / f"{name}.ome.tif" for name in "ab"]
    value = np.random.default_rng(2).random((3, 8, 9)).astype(np.float32)
    for path in paths:
        write_volume_tiff(path, value, value, np.arange(3) * 1e-6, (1e-6, 1e-6))
    content = paths[0].read_bytes()
    assert content == paths[1].read_bytes()
    run_verify(paths[0])
    for place in np.random.default_rng(3).integers(len(content), size=40):
        bad = bytearray(content)
        bad[place] ^= 1
        paths[0].write_bytes(bad)
        with pytest.raises(InputError):
            read_tiff_volume(paths[0])
