"""Names that Make or the shell would read as more end a pipeline before anything runs."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PIPELINES = sorted(p.name for p in (ROOT / "pipelines").glob("*.mk"))
INCLUDED = ("common.mk", "names.mk", "spectral_captures.mk")
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(file, *words, cwd=ROOT, **environment):
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["make", "-f", str(ROOT / file), *words],
        cwd=cwd,
        env=inherited | {"PATH": path} | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    return done.returncode, done.stdout, done.stderr


HOSTILE = (
    "x&{touch,PWNED}&y.dng",
    "$(shell touch PWNED)",
    "`touch PWNED`",
    "w$x.dng",
    "a;touch${IFS}PWNED;.dng",
    "a|tee${IFS}PWNED",
    "a>PWNED",
    "it's.dng",
    'a"b.dng',
    "a\\b.dng",
    "a#b.dng",
    "x[1].dng",
    "a%b.dng",
    "a(1).dng",
    "a\ntouch PWNED",
    "a\x1b[31m.dng",
    "a\x9b31m.dng",
    "a\u202egnd.b",
)


@pytest.mark.parametrize("setting", ["WHITE", "DARK", "CAPTURES", "BANDS", "CAMERA", "RUN"])
@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_that_is_more_is_refused_before_anything_runs(tmp_path, setting, name):
    for file in ("white.dng", name.replace("/", "")):
        (tmp_path / file).touch()
    value = f"450nm={name}" if setting == "BANDS" else name
    before = sorted(os.listdir(tmp_path))
    given = {"WHITE": "white.dng", "RUN": "run"} | {setting: value}
    refusals = [
        make("pipelines/raw.mk", *(f"{k}={v}" for k, v in given.items()), cwd=tmp_path),
        make("pipelines/raw.mk", cwd=tmp_path, **given),
    ]
    for code, said, error in refusals:
        assert code == 2 and said == "", (said, error)
        assert re.search(
            rf"\*\*\* {setting} holds .*, which Make or the shell would read as more than a name; "
            r"rename the file, or call plenocli without make",
            error,
        ), error
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize(
    "file", [*(f"pipelines/{p}" for p in PIPELINES if p not in INCLUDED), "Makefile"]
)
def test_every_pipeline_looks_at_its_settings_first(tmp_path, file):
    text = (ROOT / file).read_text()
    for setting in sorted(set(re.findall(r"^([A-Z_]+) \?=", text, re.M)) | {"RUN"}):
        if setting == "RUN" and file == "Makefile":
            continue
        words = [f"{setting}=$(shell touch {tmp_path}/PWNED)x&y"]
        words += [] if setting == "DATA" or "colorchecker" not in file else [f"DATA={tmp_path}"]
        code, said, error = make(file, "-n", *words)
        assert code == 2 and f"*** {setting} holds" in error and said == "", (setting, said, error)
    assert os.listdir(tmp_path) == []


def test_every_setting_is_looked_at():
    named = (ROOT / "pipelines" / "names.mk").read_text().split("ONE_NAME")[0]
    known = set(re.findall(r"\b[A-Z]{3,}\b", named)) - {"SETTINGS"}
    files = [ROOT / "Makefile", *(ROOT / "pipelines" / p for p in PIPELINES)]
    used = {n for f in files for n in re.findall(r"^([A-Z_]+) \?=", f.read_text(), re.M)}
    assert used <= known, used - known


@pytest.mark.parametrize(
    "words, said",
    [
        (["RUN=my run"], "RUN holds a space"),
        (["RUN="], "RUN is empty"),
        (["CAMERA=my camera.toml"], "CAMERA holds a space"),
        (["CAPTURES=a:b.dng"], "CAPTURES holds :"),
        (["CAPTURES=a=b.dng"], "CAPTURES holds ="),
        (["BANDS=450nm=a=b.dng"], "BANDS holds = twice"),
    ],
)
def test_what_make_itself_takes_apart_is_said(tmp_path, words, said):
    code, out, error = make("pipelines/raw.mk", "WHITE=white.dng", *words, cwd=tmp_path)
    assert code == 2 and said in error and out == "" and os.listdir(tmp_path) == [], error


@pytest.mark.parametrize("words", [["RUNS=a b"], ["RUNS=$(shell touch PWNED)"], ["VENV="]])
def test_make_clean_takes_one_folder(words):
    code, out, error = make("Makefile", "-n", "clean", *words)
    assert code == 2 and "rm" not in out, out


def test_ordinary_names_pass(tmp_path):
    """Umlauts, spaces between names, patterns, signs that neither Make nor the shell knows."""
    for name in ("weiß-1,2@3+4^5.nef", "b450.nef", "x1.nef", "x2.nef"):
        (tmp_path / name).touch()
    given = ["WHITE=weiß-1,2@3+4^5.nef", "BANDS=450nm=b450.nef", "CAPTURES=x1.nef x*.nef"]
    code, out, error = make("pipelines/raw.mk", "-n", *given, "RUN=lauf", cwd=tmp_path)
    assert code == 0, error
    assert "calibrate --white weiß-1,2@3+4^5.nef  --band 450nm=b450.nef -o lauf/" in out


HOSTILE_SAMPLES = ("$(shell touch PWNED)", "a b.png", "a&touch PWNED&", "it's.png", "p(1).png")
HOSTILE_SAMPLES += ("a\x1b[31m.png", "a\ntouch PWNED", "a\x9b31m.png", "a\u202egnp.b", "a\x7f")


@pytest.mark.parametrize("setting", ["CAMERA", "SCENE", "RUN", "METHODS"])
@pytest.mark.parametrize("name", HOSTILE_SAMPLES)
def test_the_makefile_that_init_writes_refuses_them_too(tmp_path, setting, name):
    if setting == "METHODS" and name == "a b.png":  # a list
        return
    code, out, error = make("plenocli/samples/Makefile", f"{setting}={name}", cwd=tmp_path)
    assert code == 2 and f"*** {setting} holds" in error and out == "", error
    assert os.listdir(tmp_path) == []


def test_no_pipeline_ends_with_the_removal_of_its_own_folders(tmp_path):
    """Make takes what a pattern rule made for its own, and tried to remove folders at the end."""
    for name in ("common.mk", "names.mk"):
        shutil.copy(ROOT / "pipelines" / name, tmp_path)
    (tmp_path / "x.mk").write_text(
        "include common.mk\nall: $(RUN)/sub/a.txt\n$(RUN)/sub/%.txt: | $(RUN)/sub/\n\t@touch $@\n"
    )
    done = subprocess.run(
        ["make", "-f", "x.mk", "RUN=run"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and "rm" not in done.stdout + done.stderr, done
    assert (tmp_path / "run" / "sub").is_dir()
