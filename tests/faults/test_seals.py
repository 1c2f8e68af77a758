"""Nothing of a file that we wrote, values or notes, can be altered unseen, whatever its format."""

import hashlib
import json

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.images.exr import read_exr
from plenocli.files.images.mosaic import read_capture
from plenocli.files.images.pictures import read_picture
from plenocli.files.images.tiff_stack import read_tiff_volume, write_volume_tiff
from plenocli.files.results.scores import read_scores
from plenocli.files.seal import SEAL, publish_sealed, require_seal
from plenocli.stages.evaluation.inspect import run_inspect
from tests.faults.harness import is_clean_refusal

READERS = {
    "white.dng": read_capture,
    "capture.exr": read_capture,
    "spectra.exr": read_exr,
    "image.exr": read_exr,
    "score.json": read_scores,
    "capture.h5": read_artefact,
}


@pytest.mark.parametrize("name", READERS)
def test_any_byte_that_is_altered_is_seen(stages, tmp_path, campaign, count, name):
    """Random places all over the file, and the notes at its start more densely."""
    good, rng = (stages[0] / name).read_bytes(), np.random.default_rng(list(name.encode()))
    places = rng.integers(len(good), size=campaign(40, 2000)).tolist()
    places += rng.integers(min(len(good), 4000), size=campaign(40, 2000)).tolist()
    path = tmp_path / name
    slow = campaign(8, 400) if name.endswith("dng") else len(places)  # a process for each
    for place in places[-slow:]:
        bad = bytearray(good)
        bad[place] ^= int(rng.integers(1, 256))
        path.write_bytes(bad)
        with pytest.raises(InputError):
            READERS[name](path)
    count("one byte altered in a file of ours", mutants=slow, silent=0)
    path.write_bytes(good)
    assert READERS[name](path) is not None


def test_any_byte_of_a_tiff_that_is_altered_is_seen_by_whoever_reads_it(tmp_path, campaign):
    path, rng = tmp_path / "a.ome.tif", np.random.default_rng(8)
    write_volume_tiff(path, rng.random((2, 8, 9), np.float32), None, np.arange(2.0), (1e-6, 1e-6))
    assert run_inspect(path).content.verified
    good = path.read_bytes()
    name = good.index(b"plenocli sha256")
    near = range(name - 40, name + 20, 1 if campaign(0, 1) else 3)
    for place in [*near, *rng.integers(4, len(good), size=campaign(20, 2000)).tolist()]:
        bad = bytearray(good)
        bad[place] ^= int(rng.integers(1, 256))
        path.write_bytes(bad)
        for read in (run_inspect, read_picture, read_tiff_volume):
            with pytest.raises(InputError):
                read(path)


EDITS = {
    "white.dng": [
        (b'"exposure_s"', b'"exposure_x"'),
        (b'"gain_e_per_dn": ', b'"gain_e_per_dn": 9'),
        (b'"seal"', b'"sael"'),
        (SEAL[:16].encode(), b"plenoclx sha256 "),
        (b'"white": ', b'"white": 1'),
    ],
    "capture.exr": [
        (b"plenocli:seal", b"plenocli:sael"),
        (b"plenocli:seal", b"plenoclx:seal"),
        (b"noise_sigma", b"noise_sigmb"),
        (SEAL[:16].encode(), b"plenoclx sha256 "),
    ],
    "score.json": [
        (b'"seal"', b'"sael"'),
        (b'"psnr_db": 1', b'"psnr_db": 9'),
        (b'"results"', b'"resultz"'),
        (SEAL[:16].encode(), b"plenoclx sha256 "),
    ],
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_of_the_notes_is_refused(runner, stages, tmp_path, name):
    good = (stages[0] / name).read_bytes()
    for old, new in EDITS[name]:
        if old not in good:
            old, new = old[:-1], new[:-1] + b"#"
        assert old in good, old
        path = tmp_path / name
        path.write_bytes(good.replace(old, new, 1))
        with pytest.raises(InputError):
            READERS[name](path)


def test_a_capture_with_another_exposure_gives_no_spectra(runner, stages, tmp_path):
    """The exposure divides all spectra: it stands in the notes, not in the mosaic."""
    good = (stages[0] / "colorchecker.dng").read_bytes()
    place = good.index(b'"exposure_s": ') + len(b'"exposure_s": ')
    digit = next(i for i in range(place, place + 20) if good[i : i + 1] in b"123456789")
    bad = tmp_path / "chart.dng"
    bad.write_bytes(good[:digit] + (b"9" if good[digit] != ord("9") else b"8") + good[digit + 1 :])
    (tmp_path / "calibration.h5").symlink_to(stages[0] / "calibration.h5")
    for command in ("demux chart.dng --calibration calibration.h5 -o s.h5", "inspect chart.dng"):
        assert is_clean_refusal(runner.run(command.split(), tmp_path), 3, "not sealed"), command
    assert not (tmp_path / "s.h5").exists()


def test_files_of_other_programs_need_no_seal(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"results": [{"name": "a", "metrics": {}}]}))
    assert not require_seal(tmp_path / "x.json") and read_scores(tmp_path / "x.json") is not None


@pytest.mark.parametrize("size", [80, 1 << 22, (1 << 22) + 31, 9_000_001])
def test_the_seal_is_the_digest_of_all_other_bytes(tmp_path, size):
    """By hashlib over the whole content at once, whatever pieces the file was written in."""
    content = np.random.default_rng(size).bytes(size).replace(b"plenocli", b"")
    publish_sealed(tmp_path / "a", [b"x" * 7 + SEAL.encode(), content])
    stored = (tmp_path / "a").read_bytes()
    place = stored.index(b"plenocli sha256 ") + 16
    zeros = stored[:place] + b"0" * 64 + stored[place + 64 :]
    assert hashlib.sha256(zeros).hexdigest().encode() == stored[place : place + 64]
    assert require_seal(tmp_path / "a")
    (tmp_path / "a").write_bytes(stored + b"\0")
    with pytest.raises(InputError, match="not sealed"):
        require_seal(tmp_path / "a")
    with pytest.raises(ValueError, match="no place"):
        publish_sealed(tmp_path / "b", [b"plenocli"])
    assert not (tmp_path / "b").exists()


JOURNALS = [
    b"5",
    b"[[1], 2]",
    b"[" * 100_000,
    b'["KEY", {"status": 0, "metrics": {"psnr_db": {"a": 1}}}]',
    b'["KEY", {"status": 0, "metrics": {"psnr_db": 1e300}}]',
    b'["KEY", {"status": 0, "metrics": {"\\u001b[31m": 1}}]',
    b'["KEY", {"status": 0, "metrics": {}, "stages": {"score": NaN}}]',
]


@pytest.mark.parametrize("text", JOURNALS, ids=range(len(JOURNALS)))
def test_a_journal_of_nonsense_with_true_checksums_is_worked_out_anew(
    runner, stages, tmp_path, text
):
    for path in filter(lambda p: p.is_file(), stages[0].iterdir()):
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "s.parts").mkdir()
    lines = (stages[0] / "sweep.parts" / "points.jsonl").read_bytes().split(b"\n")
    keys = [json.loads(line.partition(b" ")[2])[0].encode() for line in lines if line]
    texts = [text.replace(b"KEY", key) for key in keys]
    sealed = [hashlib.sha256(t).hexdigest()[:16].encode() + b" " + t + b"\n" for t in texts]
    (tmp_path / "s.parts" / "points.jsonl").write_bytes(b"".join(sealed))
    outcome = runner.run(["sweep", "designs.toml", "-o", "s.h5"], tmp_path)
    assert outcome.code == 0 and "2 computed now" in outcome.text, outcome
    assert (tmp_path / "s.h5").read_bytes() == (stages[0] / "sweep.h5").read_bytes()
