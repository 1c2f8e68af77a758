"""The tables print themselves, and the printed page names every dataset and attribute."""

import subprocess
import sys

from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.schema import ROOT_ATTRIBUTES


def test_documentation_page_names_everything():
    done = subprocess.run(
        [sys.executable, "-m", "plenocli.files.artefacts"],
        capture_output=True,
        text=True,
        check=True,
    )
    for name in ROOT_ATTRIBUTES:
        assert f"`{name}`" in done.stdout
    for schema in SCHEMAS.values():
        assert f"## {schema.kind} (version {schema.version})" in done.stdout
        for field in schema.fields:
            assert f"| `/{field.path}` |" in done.stdout
        for where, attrs in schema.attrs.items():
            for attr in attrs:
                assert f"| `/{where}` | `{attr.name}` |" in done.stdout


def test_every_field_and_attribute_is_explained():
    for schema in SCHEMAS.values():
        assert all(len(field.doc) > 5 for field in schema.fields)
        assert all(
            attr.doc and attr.type in ("number", "text", "json", "flag")
            for attrs in schema.attrs.values()
            for attr in attrs
        )


def test_contract_names_are_there():
    due = {
        "pif": (
            "pif/A",
            "pif/wavelength",
            "pif/lenslet_offset",
            "pif/pixel_shape",
            "pif/object_shape",
            "pif/column_energy",
            "pif/singular_values",
        ),
        "capture": ("capture/mosaic", "capture/cfa", "capture/lenslet_centre", "capture/scene"),
        "calibration": (
            "grid/centre",
            "grid/valid",
            "grid/residual",
            "white/flat",
            "dark/mean",
            "response/F",
            "response/origin",
            "response/window",
            "response/covariance",
            "response/wavelength",
            "response/white",
        ),
        "spectra": ("spectra/value", "spectra/sigma", "spectra/wavelength"),
        "dictionary": ("dictionary/atoms", "dictionary/history/objective", "dictionary/state/rng"),
        "image": ("image/value", "image/sigma"),
    }
    for kind, paths in due.items():
        assert all(SCHEMAS[kind].field_for(path) for path in paths), kind
