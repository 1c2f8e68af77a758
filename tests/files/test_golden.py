"""Files of every schema version that plenocli ever wrote, kept in tests/golden: they read, with
their values, or are refused with the command that makes them anew.

A new version of a kind gets a new file: python tests/files/test_golden.py writes those that are
missing. None is ever replaced.
"""

from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact

GOLDEN = Path(__file__).resolve().parents[1] / "golden"


def fill(schema):
    """An artefact of a kind with every dataset of its table that has a fixed name, filled by a
    rule that needs no random numbers.
    """
    sizes, data = {}, {}
    for field in schema.fields:
        if field.dims is None or "*" in field.path:
            continue
        axes = field.dims.split("|")[0].split()
        shape = tuple(
            sizes.setdefault(axis, int(axis) if axis.isdigit() else 2 + len(axis) % 2)
            for axis in axes
        )
        count = int(np.prod(shape))
        values = (np.arange(count) + 1) / (count + 1)
        kind = field.dtype.split()[0]
        values = {
            "f": values,
            "i": np.arange(count) + 1,
            "b": np.arange(count) % 2 == 0,
            "u": (np.arange(count) + 1).astype(np.uint16),
            "S": np.full(count, b"mono"),
        }.get(kind)
        if values is not None:
            data[field.path] = values.reshape(shape)
    return Artefact(
        schema.kind,
        data,
        {},
        Provenance(
            command=f"plenocli makes-{schema.kind}",
            inputs={"camera": {"name": "camera.toml", "sha256": "0" * 64}},
            seed=3,
            config="[light]\n",
            accuracy={"asked": 1e-3},
        ),
    )


def name_of(schema):
    return f"{schema.kind}-{schema.version}.h5"


@pytest.mark.parametrize("kind", SCHEMAS)
def test_every_version_in_use_has_its_golden_file(kind):
    assert (GOLDEN / name_of(SCHEMAS[kind])).exists(), (
        "run this file as a script, and commit what it writes"
    )


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.h5")), ids=lambda p: p.stem)
def test_old_files_read_with_their_values_or_say_how_to_make_them_anew(count, path):
    kind, _, version = path.stem.rpartition("-")
    if int(version) != SCHEMAS[kind].version:
        with pytest.raises(InputError, match=f"plenocli makes-{kind}"):
            read_artefact(path)
        return count("golden files of old versions", refused_with_the_command=1)
    found, expected = read_artefact(path, kind), fill(SCHEMAS[kind])
    assert found.provenance == expected.provenance
    assert set(found.data) >= {
        field.path for field in SCHEMAS[kind].fields if not field.optional and "*" not in field.path
    }
    for name, values in found.data.items():
        np.testing.assert_array_equal(values, expected.data[name])
    count("golden files of schema versions", read_with_their_values=1)


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for schema in SCHEMAS.values():
        if not (GOLDEN / name_of(schema)).exists():
            write_artefact(GOLDEN / name_of(schema), fill(schema))
