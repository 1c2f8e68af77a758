"""The wheel in a fresh environment without the repository: it installs, writes its samples, and
their Makefile runs the chain."""

import json
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from plenocli import __version__

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "THIRD_PARTY.md", "plenocli", "sample_configs")
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def call(
    *words: str | Path, folder: Path, path: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """A command in `folder` that knows nothing of the repository; programs in `path` come first."""
    kept = {
        k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "PYTHON", "VIRTUAL_ENV"))
    }
    if path is not None:
        kept["PATH"] = os.pathsep.join([str(path), kept["PATH"]])
    return subprocess.run(
        words, cwd=folder, env=kept | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )


def pip(*words: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    return call(sys.executable, "-m", "pip", "--disable-pip-version-check", *words, folder=folder)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, as `make wheel` builds it, of a copy of the sources, since building litters."""
    folder = tmp_path_factory.mktemp("sources")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name,
                folder / name,
                symlinks=True,
                ignore=shutil.ignore_patterns("__pycache__", "runs"),
            )
        else:
            shutil.copy(ROOT / name, folder)
    done = pip("wheel", "--no-deps", "--no-build-isolation", "-w", "dist", ".", folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "dist" / f"plenocli-{__version__}-py3-none-any.whl"


@pytest.fixture
def fresh(tmp_path: Path) -> Path:
    """The folder of programs of an environment with nothing in it, not even pip."""
    call(sys.executable, "-m", "venv", "--without-pip", "env", folder=tmp_path).check_returncode()
    return tmp_path / "env" / "bin"


def samples() -> list[Path]:
    home = ROOT / "sample_configs"
    return [home / "Makefile", *home.glob("*.toml"), *home.glob("*/*.toml"), *home.glob("*/*.csv")]


def require_it_runs(folder: Path, programs: Path) -> None:
    """Follow the advice of `plenocli` alone in an empty folder, with the plenocli in `programs`."""
    home = folder / "user"
    home.mkdir()
    where = call(
        programs / "python", "-c", "import plenocli; print(plenocli.__file__)", folder=home
    )
    assert where.stdout.startswith(str(programs.parent)), where.stdout + where.stderr
    advice = (
        call("plenocli", folder=home, path=programs)
        .stdout.rpartition("Next: ")[2]
        .partition(",")[0]
    )
    assert advice == "plenocli init && make -C plenocli-start"
    for command in advice.split(" && "):
        done = call(*shlex.split(command), folder=home, path=programs)
        assert done.returncode == 0, done.stdout + done.stderr
    again = call("make", "-C", "plenocli-start", folder=home, path=programs)
    assert again.returncode == 0 and "plenocli " not in again.stdout
    score = json.loads(
        (home / "plenocli-start" / "runs" / "tiny-astronaut" / "score.json").read_text()
    )
    found = {r["label"]: r["metrics"]["psnr_db"] for r in score["results"]}
    assert found["lmmse"] > found["tikhonov"] > found["block-mean"] + 5


def test_the_wheel_holds_package_samples_and_licence_and_nothing_else(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    info = f"plenocli-{__version__}.dist-info"
    carried = [*samples(), *(ROOT / "plenocli").rglob("*.py")]
    wanted = {
        str(p.relative_to(ROOT)).replace("sample_configs", "plenocli/samples") for p in carried
    }
    wanted |= {f"{info}/licenses/{name}" for name in ("LICENSE", "THIRD_PARTY.md")}
    assert wanted <= names and {name.split("/")[0] for name in names} == {"plenocli", info}


def test_it_runs_where_the_repository_is_not(tmp_path: Path, wheel: Path, fresh: Path) -> None:
    """The packages it needs are lent by this environment, behind its own."""
    done = pip(
        "--python", fresh / "python", "install", "--no-deps", "--no-index", wheel, folder=tmp_path
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (own,) = (fresh.parent / "lib").glob("python*/site-packages")
    lent = dict.fromkeys(sysconfig.get_path(kind) for kind in ("purelib", "platlib"))
    (own / "lent.pth").write_text("\n".join(lent))
    require_it_runs(tmp_path, fresh)


@pytest.mark.slow
def test_it_runs_with_what_the_index_has_and_a_hint_followed_draws_pictures(
    tmp_path: Path, wheel: Path, fresh: Path
) -> None:
    install = ("--python", fresh / "python", "install", "--quiet", "-c", ROOT / "constraints.txt")
    probe = pip(*install, "click", folder=tmp_path)
    if probe.returncode:
        pytest.skip(f"no package index in reach: {probe.stderr.strip().splitlines()[-1]}")
    done = pip(*install, wheel, folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    require_it_runs(tmp_path, fresh)
    report = ("make", "-C", "plenocli-start", "report")
    refused = call(*report, folder=tmp_path / "user", path=fresh)
    hint = refused.stderr.partition("; pip install ")[2].partition("\n")[0]
    assert refused.returncode and hint.startswith("'matplotlib>="), refused.stderr
    assert pip(*install, *shlex.split(hint), folder=tmp_path).returncode == 0
    drawn = call(*report, folder=tmp_path / "user", path=fresh)
    assert drawn.returncode == 0, drawn.stdout + drawn.stderr
