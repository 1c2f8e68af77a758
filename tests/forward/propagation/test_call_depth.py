"""From --accuracy to the squares of the field: few frames, in few files."""

import sys
from pathlib import Path

import numpy as np
import pytest

import plenocli
from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif

PACKAGE = Path(plenocli.__file__).parent
SAMPLES = PACKAGE.parent / "sample_configs"
MOST_FRAMES, MOST_FILES = 5, 3


def frames_up():
    """(file, function) of the package's frames from the caller up to the stage, without it."""
    frame, found = sys._getframe(1), []
    while frame is not None:
        file = Path(frame.f_code.co_filename)
        if file.name == "simulate_pif.py":
            break
        if file.is_relative_to(PACKAGE):
            found.append((file.name, frame.f_code.co_name))
        frame = frame.f_back
    assert frame is not None
    return found[::-1]


@pytest.mark.parametrize(
    "config, settings",
    [
        ("tiny", {}),
        # superpixels with factors of their own
        ("seed_spatial", {"superpixels": (3, 3), "coherent_ring": 1}),
    ],
)
def test_from_the_command_to_the_squares_of_the_field(config, settings, tmp_path, monkeypatch):
    camera = tmp_path / "camera.toml"
    text = (SAMPLES / f"{config}.toml").read_text()
    camera.write_text(
        text.replace("samples_per_lenslet = [40, 40]", "samples_per_lenslet = [8, 8]")
    )
    seen, einsum = set(), np.einsum

    def watched(subscripts, *operands, **options):
        if len(operands) == 2 and operands[0] is operands[1]:
            path = tuple(frames_up())
            if path[0] != ("diagnosis.py", "describe"):  # which squares energies, not fields
                seen.add(path)
        return einsum(subscripts, *operands, **options)

    monkeypatch.setattr(np, "einsum", watched)
    asked = Settings(model="fresnel", accuracy=1e-2, **settings)
    run_simulate_pif(camera, tmp_path / "pif.h5", asked)
    assert seen, "no square of a field was seen"
    for path in seen:
        assert path[0] == ("system_matrix.py", "build_pif")
        assert path[-1][0] == "separable_fields.py"
        assert len(path) <= MOST_FRAMES, path
        assert len({file for file, _ in path}) <= MOST_FILES, path
