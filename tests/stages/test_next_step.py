"""`plenocli` alone: the pipeline, and a command that works here and now; silence
and costs on request.
"""

import shlex
from pathlib import Path

from plenocli.cli.main import run
from plenocli.stages.next_step import next_step

TINY = Path(__file__).resolve().parents[2] / "sample_configs" / "tiny.toml"


def test_following_the_advice_leads_to_a_score(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert next_step(".").startswith("plenocli init && make -C plenocli-start")
    (tmp_path / "camera.toml").write_text(TINY.read_text())
    (tmp_path / "notes.toml").write_text("x = 1")
    (tmp_path / "broken.h5").write_bytes(b"nothing")
    steps = []
    while not (tmp_path / "score.json").exists():
        steps.append(shlex.split(next_step("."))[1:])
        assert run(steps[-1]) == 0, steps
        assert len(steps) < 6
    assert [s[0] for s in steps] == ["simulate-pif", "capture-sim", "reconstruct", "score"]
    capsys.readouterr()
    assert run([]) == 0
    out = capsys.readouterr().out
    assert "--simulate-pif-->" in out and out.rstrip().splitlines()[-1].startswith(
        "Next: plenocli score"
    )


def test_quiet_says_results_only_and_verbose_what_they_cost(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    command = [
        "simulate-pif",
        str(TINY),
        "--superpixels",
        "1x1",
        "--coherent-ring",
        "0",
        "--overwrite",
        "-o",
        "pif.h5",
    ]
    assert run(["--quiet", *command]) == 0
    out, err = capfd.readouterr()
    assert out.startswith("pif.h5: A of") and err == ""
    assert run(["--verbose", *command]) == 0
    assert "of processor time" in capfd.readouterr().err
    assert run(["--quiet", "inspect", "none.h5"]) == 3 and "none.h5" in capfd.readouterr().err
