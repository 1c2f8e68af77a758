"""What makes a benchmark measure a model anew: the code that computes it, and nothing else."""

import shutil
from pathlib import Path

import pytest

from plenocli.forward.propagation.models import MODELS

ROOT = Path(__file__).resolve().parents[3]
NAMES = [model.name for model in MODELS]
PROPAGATION = "plenocli/forward/propagation"


@pytest.fixture
def code(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "pipelines" / "benchmarks")
    import model_code

    return model_code


@pytest.fixture
def copy(tmp_path):
    shutil.copytree(ROOT / "plenocli", tmp_path / "plenocli")
    return tmp_path


def digests(code, root):
    return {name: code.model_code(name, root) for name in NAMES}


def changed(code, copy, file, old, new):
    """Names of the models whose digest a change of one text in one file changes."""
    before, path = digests(code, copy), copy / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    after = digests(code, copy)
    return [name for name in NAMES if before[name] != after[name]]


@pytest.mark.parametrize(
    "file, old, new, models",
    [
        (
            f"{PROPAGATION}/bands.py",
            "total += weight * part",
            "total += 1.1 * weight * part",
            NAMES,
        ),
        (f"{PROPAGATION}/sampling.py", "NARROWING_LOSS = 2.0", "NARROWING_LOSS = 20.0", NAMES),
        (
            f"{PROPAGATION}/fresnel/square.py",
            "TERM_VALUES = 1 << 21",
            "TERM_VALUES = 1 << 20",
            NAMES[1:2],
        ),
        (f"{PROPAGATION}/fresnel/shaped.py", "PIECES = 6", "PIECES = 7", NAMES[2:3]),
        (f"{PROPAGATION}/exact/lenslets.py", "LEAST = 1e-10", "LEAST = 2e-10", NAMES[3:4]),
        (
            f"{PROPAGATION}/exact/prolate.py",
            "return ",
            "return 2 * ",
            NAMES[3:4],
        ),
        (f"{PROPAGATION}/exact/debye.py", "return ", "return 2 * ", NAMES[3:]),
        (f"{PROPAGATION}/harmonics/pixels.py", "return ", "return 2 * ", NAMES[4:5]),
        (f"{PROPAGATION}/exact/openings.py", "KERNEL_CUT = 0.1", "KERNEL_CUT = 0.2", NAMES[5:]),
        (f"{PROPAGATION}/ray/rays.py", "FOCUSED = 1e-9", "FOCUSED = 1e-8", NAMES[:1]),
        ("plenocli/forward/camera/quadrature.py", "return ", "return 2 * ", NAMES),
    ],
)
def test_a_change_of_what_computes_is_seen(code, copy, file, old, new, models):
    assert changed(code, copy, file, old, new) == models


@pytest.mark.parametrize(
    "file, old, new",
    [
        ("plenocli/forward/accuracy/dial.py", "SHARE = 0.2", "SHARE = 0.3"),
        (f"{PROPAGATION}/diagnosis.py", "LARGEST = 4000", "LARGEST = 5000"),
        (f"{PROPAGATION}/response.py", "TAIL = 6", "TAIL = 7"),
        (f"{PROPAGATION}/costs.toml", "[", "# measured again\n["),
        (f"{PROPAGATION}/ray/rays.py", '"""', '"""Words. '),
        (f"{PROPAGATION}/ray/rays.py", "def features(", "def features(_=0, *, "),
    ],
)
def test_what_does_not_compute_changes_nothing(code, copy, file, old, new):
    assert changed(code, copy, file, old, new) == []


def test_a_model_is_computed_by_its_own_modules_and_what_they_share(code):
    found = {name: code.modules_of(name, ROOT) for name in NAMES}
    names = [
        *("ray.rays", "fresnel.square", "fresnel.shaped"),
        *("exact.lenslets", "harmonics.lenslets", "exact.openings"),
    ]
    for name, own in zip(NAMES, names, strict=True):
        of = [n for n in NAMES if f"plenocli.forward.propagation.{own}" in found[n]]
        assert of == [name]
        assert "plenocli.forward.propagation.system_matrix" in found[name]
        assert not [
            m for m in found[name] if m.split(".")[1] not in ("base", "forward", "__init__")
        ]
