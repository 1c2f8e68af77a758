"""Provenance as text attributes of an EXR."""

import pytest

from plenocli.files.artefacts.provenance import Provenance, provenance_texts, read_provenance_texts


@pytest.mark.parametrize(
    "provenance",
    [
        Provenance(command=""),
        Provenance(
            command="plenocli demux a.h5",
            inputs={"capture": {"name": "a.h5", "sha256": "0" * 64}},
            seed=0,
            config="[sensor]\n",
            accuracy={"asked": 1e-3},
        ),
    ],
)
def test_texts_bring_everything_back(provenance):
    texts = provenance_texts(provenance)
    assert all(isinstance(text, str) and text for text in texts.values())
    assert read_provenance_texts(texts | {"method": "wls"}) == provenance


def test_broken_texts_count_as_absent():
    assert read_provenance_texts({"plenocli:inputs": "{", "plenocli:command": "c"}) == Provenance(
        command="c"
    )
    assert read_provenance_texts({"plenocli:inputs": "[1]", "plenocli:seed": "x"}) == Provenance(
        command=""
    )
