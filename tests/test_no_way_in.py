"""Nothing that a file says is run, followed or drawn as markup."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.shards import read_pif
from plenocli.files.artefacts.writing import write_artefact
from plenocli.stages.evaluation.report import run_report

PACKAGE = Path(__file__).resolve().parents[1] / "plenocli"
FORBIDDEN_MODULES = {
    "pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "shelve",
    "marshal",
    "yaml",
    "joblib",
    "jsonpickle",
    "xmlrpc",
}
FORBIDDEN_CALLS = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "os.system",
    "os.popen",
    "builtins.eval",
    "np.fromstring",
}
FORBIDDEN_KEYWORDS = {"shell", "allow_pickle"}


def offences(text):
    """What in Python source `text` could run what a file says: (line, what)."""
    found = []
    for node in ast.walk(ast.parse(text)):
        names = (
            [a.name for a in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
        found += [(node.lineno, n) for n in names if n.split(".")[0] in FORBIDDEN_MODULES]
        if isinstance(node, ast.Call):
            if ast.unparse(node.func) in FORBIDDEN_CALLS:
                found.append((node.lineno, ast.unparse(node.func)))
            found += [
                (node.lineno, k.arg)
                for k in node.keywords
                if k.arg in FORBIDDEN_KEYWORDS
                and not (isinstance(k.value, ast.Constant) and k.value.value is False)
            ]
    return found


@pytest.mark.parametrize(
    "text, count",
    [
        ("import pickle", 1),
        ("from yaml import load", 1),
        ("eval(x)", 1),
        ("np.load(f, allow_pickle=True)", 1),
        ("np.load(f, allow_pickle=False)", 0),
        ("subprocess.run(c, shell=True)", 1),
        ("import json\njson.loads(x)", 0),
        ("model.evaluate(x)", 0),
    ],
)
def test_the_check_finds_what_it_looks_for(text, count):
    assert len(offences(text)) == count


def test_no_module_runs_what_a_file_says(count):
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 100
    assert {
        str(f.relative_to(PACKAGE)): offences(f.read_text())
        for f in files
        if offences(f.read_text())
    } == {}
    count("modules that run, unpickle or evaluate what a file says", modules=len(files), found=0)


DECODERS = """
import sys
from pathlib import Path
import numpy as np
from plenocli.files.images import mosaic, pictures, spectral_exr, tiff_stack
folder = Path(sys.argv[1])
mosaic.read_capture(folder / "x.dng")
mosaic.read_capture(folder / "x.exr")
pictures.read_picture(folder / "x.png")
tiff_stack.read_tiff_volume(folder / "x.tif")
print(*(name for name in ("rawpy", "OpenImageIO", "tifffile", "exifread") if name in sys.modules))
"""


def test_nothing_decodes_a_picture_or_a_raw_file_in_this_process(tmp_path):
    """The libraries are not even loaded where files are read."""
    import OpenImageIO as oiio

    from plenocli.files.images.dng import write_dng
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.tiff_stack import write_volume_tiff

    values = np.arange(900, dtype=np.uint16).reshape(30, 30)
    write_dng(tmp_path / "x.dng", values, cfa="RGGB", black=0, white=16383)
    write_exr(tmp_path / "x.exr", {"Y": values.astype(np.float32)})
    write_volume_tiff(
        tmp_path / "x.tif", np.ones((2, 4, 4)), None, np.array([0.0, 1e-6]), (1e-6, 1e-6)
    )
    output = oiio.ImageOutput.create("png")
    assert output.open(str(tmp_path / "x.png"), oiio.ImageSpec(30, 30, 1, "uint16"))
    assert output.write_image(values) and output.close()
    command = [sys.executable, "-c", DECODERS, str(tmp_path)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(PACKAGE.parent)},
    )
    assert done.returncode == 0 and done.stdout.split() == [], done.stderr + done.stdout


@pytest.mark.parametrize("name", ["../secret.h5", "/etc/passwd", "a/b.h5", "", "x\0.h5", 3])
def test_names_inside_a_file_never_become_paths(tmp_path, name):
    (tmp_path / "secret.h5").write_bytes(b"x")
    folder = tmp_path / "here"
    folder.mkdir()
    data = {
        "pif/wavelength": np.array([5e-7]),
        "pif/lenslet_offset": np.zeros((1, 2), int),
        "pif/pixel_shape": np.array([2, 2]),
        "pif/object_shape": np.array([1, 1]),
        "pif/column_energy": np.ones((1, 1)),
        "pif/shard": np.zeros(1, np.int32),
    }
    write_artefact(
        folder / "i.h5",
        Artefact(
            "pif-index",
            data,
            {"pif": {"shards": [{"name": name, "sha256": "0" * 64}]}},
            Provenance(command="t"),
        ),
    )
    with pytest.raises(InputError, match="i.h5: does not name the files"):
        read_pif(folder / "i.h5")


def test_the_report_escapes_what_files_say(tmp_path):
    evil = '<script>alert(1)</script>"><img src=x onerror=y>'
    (tmp_path / "run").mkdir()
    write_artefact(
        tmp_path / "run" / "a.h5",
        Artefact(
            "image",
            {"image/value": np.random.default_rng(0).random((8, 8))},
            {"image": {"method": evil}},
            Provenance(
                command=evil,
                inputs={evil: {"name": evil, "sha256": "0" * 64}},
                seed=1,
                config=evil,
                accuracy={evil: evil},
            ),
        ),
    )
    (tmp_path / "run" / "score.json").write_text(
        '{"results": [{"name": "x", "label": "%s", "metrics": {"psnr_db": 3.0}}], "command": "%s"}'
        % ((evil.replace('"', '\\"'),) * 2)
    )
    run_report(tmp_path / "run", tmp_path / "r.html", title=evil)
    page = (tmp_path / "r.html").read_text()
    assert "&lt;script&gt;" in page and "<script" not in page and "<img src=x" not in page
