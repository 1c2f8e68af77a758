"""Axes have names that other readers find: HDF5 dimension scales, as netCDF-4 has them."""

import h5py
import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.files.artefacts.container import HEADER_BYTES, Artefact
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import seal, write_artefact

LENGTHS = {
    "band": 2,
    "lenslet": 1,
    "pixel": 6,
    "point": 4,
    "value": 4,
    "row": 6,
    "column": 8,
    "lenslet_row": 3,
    "lenslet_column": 4,
    "plane": 5,
    "view_row": 2,
    "view_column": 3,
}


def whole(kind):
    """An artefact of `kind` with every dataset whose axes the table names."""
    data = {}
    for entry in SCHEMAS[kind].fields:
        for dims in (entry.alternatives() or ())[:1]:
            shape = [int(d) if d.isdigit() else LENGTHS.setdefault(d, 7) for d in dims]
            values = np.arange(1, 1 + np.prod(shape, dtype=int)).reshape(shape)
            letter = entry.dtype.split()[0]
            data[entry.path] = (
                np.full(shape, b"x")
                if letter == "S"
                else values.astype({"f": "f8", "i": "i4", "b": "?"}[letter])
            )
    return Artefact(kind, data, {}, Provenance(command="plenocli test"))


@pytest.mark.parametrize("kind", SCHEMAS)
def test_every_axis_of_the_tables_has_one_scale_of_its_length(tmp_path, kind):
    path, made = tmp_path / "a.h5", whole(kind)
    write_artefact(path, made)
    named = 0
    with h5py.File(path) as file:
        for name in made.data:
            dataset = file[name]
            if dataset.is_scale:
                continue
            scales = [axis[0] for axis in dataset.dims]
            assert [len(axis) for axis in dataset.dims] == [1] * dataset.ndim
            assert [scale.shape for scale in scales] == [(n,) for n in dataset.shape]
            assert len({scale.name for scale in scales}) == dataset.ndim  # xarray wants them so
            assert all(scale.parent == dataset.parent for scale in scales)
            named += dataset.ndim
    assert named or kind in (
        "dictionary",
        "checkpoint",
        "pif-planes",
    )  # planes are the scale itself
    read = read_artefact(path, kind)
    assert read.data.keys() == made.data.keys()
    assert all(np.array_equal(read.data[name], values) for name, values in made.data.items())


def test_an_axis_with_values_goes_by_their_name(tmp_path):
    write_artefact(tmp_path / "a.h5", whole("pif"))
    with h5py.File(tmp_path / "a.h5") as file:
        names = [axis[0].name for axis in file["pif/A"].dims]
        assert names == ["/pif/wavelength", "/pif/lenslet", "/pif/pixel", "/pif/point"]
        assert file["pif/A"].dims[0][0][()].tolist() == file["pif/wavelength"][()].tolist()


def test_xarray_shows_the_names(tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    write_artefact(tmp_path / "a.h5", whole("pif"))
    found = xarray.open_dataset(tmp_path / "a.h5", group="pif", engine="h5netcdf")
    assert found["A"].dims == ("wavelength", "lenslet", "pixel", "point")


def rewritten(path, change):
    """The artefact's HDF5 file changed through h5py, with a digest that fits again."""
    inner = path.with_suffix(".inner")
    inner.write_bytes(path.read_bytes()[HEADER_BYTES:])
    with h5py.File(inner, "r+") as file:
        change(file)
    with open(path, "w+b") as out:
        out.write(b"\0" * HEADER_BYTES + inner.read_bytes())
        out.flush()
        seal(out.fileno(), inner.stat().st_size)


def test_only_scales_may_hold_references(tmp_path):
    path = tmp_path / "a.h5"

    def refers(file):
        file["pif"].attrs.create("notes", file["pif/A"].ref, dtype=h5py.ref_dtype)

    def fake(file):
        del file["pif/A"].attrs["DIMENSION_LIST"]
        file["pif/A"].attrs["DIMENSION_LIST"] = [1.0]

    def hides(file):  # values of another shape under an empty axis's name are unknown data
        made = file.create_dataset("pif/secret", data=np.zeros((2, 2)))
        made.make_scale("This is a netCDF dimension but not a netCDF variable.          2")

    for change, told in ((refers, "references"), (fake, None), (hides, "secret")):
        write_artefact(path, whole("pif"), overwrite=True)
        rewritten(path, change)
        if told is None:
            read_artefact(path)
        else:
            with pytest.raises(InputError, match=told):
                read_artefact(path)


def test_same_input_same_bytes(tmp_path):
    for name in ("a.h5", "b.h5"):
        write_artefact(tmp_path / name, whole("capture"))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
