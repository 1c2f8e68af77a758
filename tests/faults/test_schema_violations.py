"""Every rule of every table of artefacts, broken one at a time in a file that is sealed anew: the
reader refuses each, naming the file; what keeps all rules but is extreme is no bug of any command.
"""

import hashlib
import io
import shutil

import h5py
import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.reading import read_artefact
from tests.faults.harness import mutants
from tests.faults.test_resealed import MAGIC, attribute, other, resealed, values, without

FILES = (
    "pif.h5",
    "capture.h5",
    "predicted.h5",
    "calibration.h5",
    "spectra.h5",
    "dictionary.h5",
    "image.h5",
    "planes.h5",
    "sweep.h5",
    "stack.h5",
    "field.h5",
    "kernels.h5",
    "volume.h5",
    "fit.h5",
    "shards.h5",
    "unfinished.h5",
)
HUGE = 3e100


def first(change):
    """A change of the first number alone."""

    def changed(stored):
        stored = np.array(stored)
        stored.flat[0] = change(stored.flat[0])
        return stored

    return changed


def broken_datasets(schema, file):
    """(what is broken, edit) for the rules of all datasets that are in the file."""
    for field in schema.fields:
        path, is_open = field.path, field.path.endswith("/*")
        if is_open or path not in file:
            continue
        stored = file[path][()]
        kind, dims = stored.dtype.kind, (field.dims or "").split("|")
        if not field.optional:
            yield f"{path} missing", without(path)
        yield f"{path} of complex numbers", other(path, lambda v: np.zeros(np.shape(v), "c16"))
        if kind in "fiu":
            yield f"{path} as text", other(path, lambda v: np.full(np.shape(v), b"x" * 70))
        if field.dims is not None:
            yield f"{path} with an axis more", other(path, lambda v: np.asarray(v)[None, None])
            if stored.ndim and not any(part.strip() == "" for part in dims):
                yield f"{path} without anything", other(path, lambda v: v[:0])
        if kind == "f" and not field.maskable and stored.size:
            yield f"{path} with NaN", values(path, first(lambda _: np.nan))
        if kind == "f" and stored.size:
            yield f"{path} with an infinity", values(path, first(lambda _: np.inf))
        if kind == "f" and stored.dtype.itemsize == 8 and stored.size:
            yield f"{path} beyond numbers", values(path, first(lambda _: HUGE))
        if field.minimum is not None and kind in "fi" and stored.size:
            least = field.minimum
            yield f"{path} below its least", values(path, first(lambda _, m=least: m - 1))
        if field.ascending and stored.size > 1:
            yield f"{path} descending", values(path, lambda v: v[::-1])
            yield f"{path} standing still", values(path, lambda v: np.full_like(v, v.flat[-1]))
    yield "an unknown dataset", lambda file: file.create_dataset("nobody/knows", data=[1.0])


def broken_attributes(schema, file):
    """The same for attributes."""
    for where, known in schema.attrs.items():
        if (where or "/") not in file:
            continue
        yield f"{where}@unknown", attribute(where or "/", "nobody_knows", 1.0)
        for attr in known:
            put = lambda value, where=where, name=attr.name: attribute(where or "/", name, value)
            about = f"{where}@{attr.name}"
            if attr.type == "number":
                yield f"{about} as text", put("three")
                yield f"{about} NaN", put(np.nan)
                yield f"{about} beyond numbers", put(HUGE)
                yield f"{about} of thousands", put(np.ones(4097))
                if attr.finite:
                    yield f"{about} infinite", put(np.inf)
                if attr.minimum is not None:
                    yield f"{about} below its least", put(np.full(attr.size or 1, attr.minimum - 1))
                if attr.size is not None:
                    yield f"{about} of another size", put(np.full(attr.size + 1, 5.0))
            elif attr.type == "text":
                yield f"{about} as a number", put(3.0)
                if attr.pattern is not None:
                    yield f"{about} out of its words", put("no such word")
            elif attr.type == "flag":
                yield f"{about} as text", put("yes")
            elif attr.type == "json":
                yield f"{about} as a number", put(3.0)
                yield f"{about} torn", put('{"a": [1,')
                yield f"{about} not finite", put('{"a": NaN}')
    for name in ("plenocli_kind", "schema_version", "inputs", "accuracy", "seed", "command"):
        yield f"root {name} missing", lambda file, name=name: file.attrs.__delitem__(name)


@pytest.mark.parametrize("name", FILES)
def test_every_rule_of_a_table_is_looked_at(stages, tmp_path, campaign, count, name):
    content = (stages[0] / name).read_bytes()
    with h5py.File(io.BytesIO(content[512:])) as file:
        schema = SCHEMAS[file.attrs["plenocli_kind"].decode()]
        tried = [*broken_datasets(schema, file), *broken_attributes(schema, file)]
    assert len(tried) > 10
    path, read = tmp_path / "x.h5", []
    rng = np.random.default_rng(25)
    for number in sorted(rng.permutation(len(tried))[: campaign(12, None)]):
        what, edit = tried[number]
        path.write_bytes(resealed(content, edit))
        try:
            read_artefact(path)
            read.append(what)
        except InputError as error:
            assert error.where == str(path), what
    assert read == []
    count("rules of tables broken in sealed files", broken=len(tried), read_nevertheless=0)


@pytest.mark.parametrize("name", FILES)
def test_hdf5_that_is_damaged_below_a_true_digest_crashes_nothing(
    runner, stages, tmp_path, campaign, count, name
):
    """Segmentation faults of HDF5 that such files cause stay in the child that decodes."""
    content, codes = (stages[0] / name).read_bytes(), []
    if name == "shards.h5":
        shutil.copytree(stages[0], tmp_path, dirs_exist_ok=True)
    for image in mutants(content[512:], campaign(1, 150), np.random.default_rng(len(content))):
        said = f"sha256 {hashlib.sha256(image).hexdigest()}\nbytes {len(image)}\n".encode()
        (tmp_path / "x.h5").write_bytes((MAGIC + said).ljust(512, b"\0") + image)
        outcome = runner.run(["inspect", "x.h5"], tmp_path)
        assert outcome.code in (0, 3) and not outcome.hung, outcome
        codes.append(outcome.code)
    count("damaged HDF5 below a true digest", files=len(codes), read=codes.count(0), signals=0)
