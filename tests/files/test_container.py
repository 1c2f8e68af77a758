"""Artefacts: what is written is read back, by us and by plain h5py; same input, same bytes;
damage and hostile files are refused.
"""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError
from plenocli.files.artefacts.container import HEADER_BYTES, MAGIC, Artefact, cfa_text
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.reading import opened_artefact, read_artefact
from plenocli.files.artefacts.writing import write_artefact
from tests.faults.harness import mutants


def spectra(seed=0, bands=3, shape=(4, 5)):
    rng = np.random.default_rng(seed)
    return Artefact(
        "spectra",
        {
            "spectra/value": rng.random((bands, *shape)),
            "spectra/sigma": rng.random((bands, *shape), dtype=np.float32),
            "spectra/wavelength": np.linspace(450e-9, 650e-9, bands),
        },
        {
            "spectra": {
                "quantity": "reflectance",
                "method": "pinv",
                "parameters": {"z": 1, "a": [1.5, None]},
            }
        },
        Provenance(
            command="plenocli demux",
            inputs={"capture": {"name": "c.h5", "sha256": "0" * 64}},
            seed=7,
            config="# Öl, 5 µm\n[light]\n",
            accuracy={"asked": 1e-3},
        ),
    )


def pif():
    rng = np.random.default_rng(3)
    return Artefact(
        "pif",
        {
            "pif/A": rng.random((2, 1, 6, 4)),
            "pif/wavelength": [5e-7, 6e-7],
            "pif/lenslet_offset": np.zeros((1, 2), int),
            "pif/pixel_shape": [2, 3],
            "pif/object_shape": [2, 2],
            "pif/column_energy": rng.random((2, 4)),
            "pif/singular_values": np.ones((2, 4)),
        },
        {"pif": {"rank": [4, 4], "condition": np.inf, "kappa": -0.5}},
    )


def signed(image):
    """Bytes of a file that holds `image` behind a correct digest block."""
    head = MAGIC + f"sha256 {hashlib.sha256(image).hexdigest()}\nbytes {len(image)}\n".encode()
    return head.ljust(HEADER_BYTES, b"\0") + image


def hostile(path, make):
    """Write an HDF5 file of the kind spectra, change it with `make(file)`, and give
    it a correct digest.
    """
    plain = path.with_suffix(".plain")
    write_artefact(path, spectra())
    plain.write_bytes(path.read_bytes()[HEADER_BYTES:])
    with h5py.File(plain, "a") as file:
        make(file)
    path.write_bytes(signed(plain.read_bytes()))
    return path


@pytest.mark.parametrize("make", [spectra, pif])
def test_everything_comes_back(tmp_path, make):
    before = make()
    write_artefact(tmp_path / "x.h5", before)
    after = read_artefact(tmp_path / "x.h5", before.kind)
    assert set(after.data) == set(before.data)
    for path, values in before.data.items():
        np.testing.assert_array_equal(after.data[path], values)
        assert after.data[path].dtype == np.asarray(values).dtype
    assert after.provenance == before.provenance
    for name, value in before.attrs[before.kind].items():
        np.testing.assert_equal(after.attrs[before.kind][name], value)


def test_plain_h5py_opens_the_result_and_finds_units_and_plot_attributes(tmp_path):
    write_artefact(tmp_path / "x.h5", spectra())
    with h5py.File(tmp_path / "x.h5") as file:
        assert file.userblock_size == 512
        np.testing.assert_array_equal(file["spectra/value"][()], spectra().data["spectra/value"])
        assert file.attrs["default"] == b"spectra" and file.attrs["plenocli_kind"] == b"spectra"
        group = file["spectra"].attrs
        assert group["NX_class"] == b"NXdata" and group["signal"] == b"value"
        assert (
            list(group["axes"]) == [b"wavelength", b".", b"."] and group["wavelength_indices"] == 0
        )
        assert file["spectra/wavelength"].attrs["units"] == b"m"
        assert json.loads(file.attrs["inputs"])["capture"]["name"] == "c.h5"


@pytest.mark.parametrize("kind", SCHEMAS)
def test_signal_of_each_kind_is_a_field_of_its_table(kind):
    schema = SCHEMAS[kind]
    assert set(schema.default) <= set(schema.plots)
    for group, (signal, companions) in schema.plots.items():
        assert all(schema.field_for(f"{group}/{name}") for name in (signal, *companions))


def test_same_input_gives_same_bytes_in_another_process_folder_zone_and_hash_seed(tmp_path):
    write_artefact(tmp_path / "here.h5", spectra())
    code = (
        "import sys; sys.path[:0] = [sys.argv[1], sys.argv[2]]; from test_container import "
        "spectra; from plenocli.files.artefacts.writing import write_artefact; "
        "write_artefact('there.h5', spectra())"
    )
    root = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
    subprocess.run(
        [sys.executable, "-c", code, root, os.path.dirname(__file__)],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "TZ": "Asia/Tokyo", "PYTHONHASHSEED": "99", "LC_ALL": "C"},
    )
    assert (tmp_path / "here.h5").read_bytes() == (tmp_path / "there.h5").read_bytes()


def test_a_config_longer_than_64_kib_survives(tmp_path):
    artefact = spectra()
    long = replace(artefact.provenance, config="# µ\n" * 50_000)
    artefact = replace(artefact, provenance=long)
    write_artefact(tmp_path / "x.h5", artefact)
    assert read_artefact(tmp_path / "x.h5").provenance.config == artefact.provenance.config


@pytest.mark.parametrize(
    "given,text", [("mono", "mono"), ("RGGB", "RGGB"), (np.array([["G", "B"], ["R", "G"]]), "GBRG")]
)
def test_colour_filter_array_as_text_or_letters(tmp_path, given, text):
    artefact = Artefact(
        "capture",
        {"capture/mosaic": np.arange(6, dtype=np.uint16).reshape(2, 3), "capture/cfa": given},
    )
    write_artefact(tmp_path / "c.h5", artefact)
    assert cfa_text(read_artefact(tmp_path / "c.h5").data["capture/cfa"]) == text


def test_writer_lists_every_broken_rule_at_once(tmp_path):
    bad = spectra()
    bad.data["spectra/value"] = bad.data["spectra/value"][:2] * 1j
    bad.data["spectra/surprise"] = np.zeros(3)
    bad.data["spectra/wavelength"] = np.array([2.0, 1.0, np.nan])
    bad.attrs["spectra"]["methd"] = "pinv"
    with pytest.raises(ValueError) as caught:
        write_artefact(tmp_path / "x.h5", bad)
    for fragment in (
        "complex128 where f is due",
        "'spectra/surprise' is unknown",
        "has 3 along 'band'",
        "does not ascend",
        "NaN",
        "'methd'",
    ):
        assert fragment in str(caught.value)
    assert os.listdir(tmp_path) == []


def test_nan_is_allowed_only_where_the_table_says_so(tmp_path):
    masked = spectra()
    masked.data["spectra/value"][0, 0, 0] = np.nan
    write_artefact(tmp_path / "x.h5", masked)
    assert np.isnan(read_artefact(tmp_path / "x.h5").data["spectra/value"][0, 0, 0])
    masked.data["spectra/value"][0, 0, 0] = np.inf
    with pytest.raises(ValueError, match="infinities"):
        write_artefact(tmp_path / "y.h5", masked)
    system = pif()
    system.data["pif/A"][0, 0, 0, 0] = -1e-9
    with pytest.raises(ValueError, match="below 0"):
        write_artefact(tmp_path / "y.h5", system)


# --- files that are refused -----------------------------------------------------------------------


def test_missing_empty_folder_foreign_and_wrong_kind_each_have_their_own_words(tmp_path):
    write_artefact(tmp_path / "s.h5", spectra())
    (tmp_path / "empty.h5").touch()
    (tmp_path / "text.h5").write_text("hello" * 200)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["pif/A"] = np.zeros(3)
    (tmp_path / "short.h5").write_bytes((tmp_path / "s.h5").read_bytes()[:300])
    (tmp_path / "cut.h5").write_bytes((tmp_path / "s.h5").read_bytes()[:-1])
    for name, words in {
        "none.h5": "does not exist",
        "": "is a folder",
        "empty.h5": "0 bytes",
        "text.h5": "not a plenocli artefact",
        "foreign.h5": "not one that plenocli wrote",
        "short.h5": "damaged digest block",
        "cut.h5": "truncated",
    }.items():
        with pytest.raises(InputError, match=words) as caught:
            read_artefact(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value) and caught.value.fix
    with pytest.raises(
        InputError, match="artefact of kind 'spectra' where 'pif or capture' is due"
    ):
        read_artefact(tmp_path / "s.h5", ("pif", "capture"))


def _external_link(file):
    file["spectra/leak"] = h5py.ExternalLink("/etc/passwd", "/x")


def _soft_link(file):
    file["spectra/alias"] = h5py.SoftLink("/spectra/value")


def _twice(file):
    file["spectra/alias"] = file["spectra/value"]


def _loop(file):
    file["spectra/loop"] = file["/"]


def _external_storage(file):
    file.create_dataset("spectra/leak", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def _virtual(file):
    layout = h5py.VirtualLayout((4,), "u1")
    layout[:] = h5py.VirtualSource("/etc/passwd.h5", "x", (4,))
    file.create_virtual_dataset("spectra/leak", layout)


def _objects(file):
    file.create_dataset("spectra/leak", data=["a", "b"], dtype=h5py.string_dtype())


def _ragged(file):
    file.create_dataset("spectra/leak", (2,), dtype=h5py.vlen_dtype(np.int32))


def _compound(file):
    file.create_dataset("spectra/leak", (2,), dtype=np.dtype([("a", "f4")]))


def _reference(file):
    file.create_dataset("spectra/leak", (2,), dtype=h5py.ref_dtype)


def _bomb(file):
    file.create_dataset(
        "spectra/leak", (200_000, 200_000), "f8", chunks=(1000, 1000), compression="gzip"
    )


def _overflowing_bomb(file):
    file.create_dataset("spectra/leak", (2**31, 2**31, 2**31), "f8", chunks=(1, 1, 1000))


def _filter(file):
    file.create_dataset("spectra/leak", data=np.zeros(4), compression="lzf")


def _named_type(file):
    file["spectra/leak"] = np.dtype("f8")


def _null(file):
    file["spectra/leak"] = h5py.Empty("f8")


def _attribute_object(file):
    file["spectra"].attrs["notes"] = "text of variable length"


def _attribute_of_dataset(file):
    file["spectra/value"].attrs.create(
        "leak", data=np.array(["x"], dtype=object), dtype=h5py.string_dtype()
    )


def _unknown_dataset(file):
    file["spectra/other"] = np.zeros(3)


def _unknown_attribute(file):
    file["spectra"].attrs["other"] = 1.0


def _newer(file):
    file.attrs["schema_version"] = 99


def _other_kind(file):
    file.attrs["plenocli_kind"] = np.bytes_(b"recipe")


def _no_command(file):
    del file.attrs["command"]


def _wrong_shape(file):
    del file["spectra/value"]
    file["spectra/value"] = np.zeros((3, 4, 6))


def _infinite(file):
    file["spectra/value"][0, 0, 0] = np.inf


@pytest.mark.parametrize(
    "make,words",
    [
        (_external_link, "external link"),
        (_soft_link, "soft link"),
        (_twice, "linked twice"),
        (_loop, "linked twice"),
        (_external_storage, "external storage"),
        (_virtual, "virtual"),
        (_objects, "variable length"),
        (_ragged, "objects"),
        (_compound, "compounds"),
        (_reference, "references"),
        (_bomb, "memory limit"),
        (_overflowing_bomb, "memory limit"),
        (_filter, "filter"),
        (_named_type, "neither a group nor a dataset"),
        (_null, "no data"),
        (_attribute_object, "variable length"),
        (_attribute_of_dataset, "variable length"),
        (_unknown_dataset, "unknown"),
        (_unknown_attribute, "'other'"),
        (_newer, "update plenocli"),
        (_other_kind, "unknown kind 'recipe'"),
        (_no_command, "missing: command"),
        (_wrong_shape, "has 5 along 'lenslet_column'|has 6 along"),
        (_infinite, "infinities"),
    ],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_hostile_files_with_a_valid_digest_are_refused_with_the_reason(tmp_path, make, words):
    path = hostile(tmp_path / "x.h5", make)
    with pytest.raises(InputError, match=words) as caught:
        read_artefact(path, "spectra")
    assert str(path) in str(caught.value)


def test_hostile_helper_itself_makes_a_good_file(tmp_path):
    assert read_artefact(hostile(tmp_path / "x.h5", lambda file: None)).kind == "spectra"


def test_memory_limit_holds_for_the_file_and_for_what_it_declares(tmp_path):
    zeros = spectra(shape=(100, 100))
    zeros.data["spectra/value"][:] = 0
    zeros.data["spectra/sigma"][:] = 0
    write_artefact(tmp_path / "x.h5", zeros)
    assert (tmp_path / "x.h5").stat().st_size < 50_000
    for memory in (150_000, 100):  # what it declares, and the file itself
        with within(Budget(memory)), pytest.raises(NumericsError, match="to be read, more than"):
            read_artefact(tmp_path / "x.h5")
    whole = (tmp_path / "x.h5").read_bytes()
    (tmp_path / "x.h5").write_bytes(whole[:-1])  # damage is damage, however little memory there is
    with within(Budget(100)), pytest.raises(InputError, match="truncated"):
        read_artefact(tmp_path / "x.h5")


@pytest.mark.parametrize("make", [spectra, pif])
def test_no_damage_is_ever_read_as_data(tmp_path, make):
    write_artefact(tmp_path / "x.h5", make())
    good, refused = (tmp_path / "x.h5").read_bytes(), 0
    for bad in mutants(good, 400, np.random.default_rng(11)):
        (tmp_path / "x.h5").write_bytes(bad)
        with pytest.raises(InputError):
            read_artefact(tmp_path / "x.h5")
        refused += 1
    assert refused > 300


def test_threads_that_read_at_the_same_time_get_their_own_files(tmp_path):
    """HDF5 takes two images of one name for one file."""
    from concurrent.futures import ThreadPoolExecutor

    for number in range(8):
        artefact = spectra()
        artefact.data["spectra/value"] = artefact.data["spectra/value"] * 0 + number
        write_artefact(tmp_path / f"{number}.h5", artefact)
    with ThreadPoolExecutor(4) as pool:
        found = list(
            pool.map(
                lambda number: (
                    read_artefact(tmp_path / f"{number % 8}.h5").data["spectra/value"].ravel()[0]
                ),
                range(160),
            )
        )
    assert found == [number % 8 for number in range(160)]


def test_damage_that_was_not_looked_for_is_told_as_damage(tmp_path):
    """Bytes all over a file, of which those of values are not looked at."""
    write_artefact(tmp_path / "a.h5", spectra())
    good, told = (tmp_path / "a.h5").read_bytes(), 0
    for at in range(HEADER_BYTES, len(good), 97):
        damaged = bytearray(good)
        damaged[at] ^= 64
        (tmp_path / "b.h5").write_bytes(damaged)
        try:
            with opened_artefact(tmp_path / "b.h5", "spectra", (), verify=False):
                pass
        except InputError as error:
            assert "its SHA-256 is not the one it was written with" in str(error)
            told += 1
    assert told > 5
