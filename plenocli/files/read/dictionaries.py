"""Dictionaries: as reconstruct uses them, and as learn-dict goes on with them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.sparse.dictionary import Dictionary, Settings, State

UNIT = 1e-3
"""By which the norm of an atom may differ from 1."""


def read_dictionary(path: Path, system: LensletMatrix) -> Dictionary:
    """The dictionary of an artefact, to be used with a system matrix; a note where it was learnt
    for another one.

    path: of the dictionary artefact.
    system: the matrix that captures are explained by.

    Raises InputError where the atoms have another number of points than the matrix, are one,
        or have another norm than 1.
    """
    from plenocli.files.artefacts.provenance import file_digest
    from plenocli.files.artefacts.reading import read_artefact

    artefact = read_artefact(path, "dictionary")
    atoms = np.asarray(artefact.data["dictionary/atoms"], float)
    if len(atoms) != system.own.shape[1]:
        several = f" in {len(system.bands)} bands" if len(system.bands) > 1 else ""
        raise InputError(
            f"has atoms of {len(atoms)} points, the system matrix {system.own.shape[1]}{several}",
            path,
            "use another method: dictionaries have one band"
            if several
            else "learn it with this pif",
        )
    if atoms.shape[1] < 2:  # the first is even, for brightness
        raise InputError("has no atom but one", path, "learn more --atoms")
    if not np.allclose(np.linalg.norm(atoms, axis=0), 1, atol=UNIT):
        raise InputError("has atoms that are not of unit norm", path, "learn it again")
    if artefact.provenance.inputs.get("pif", {}).get("sha256") != file_digest(system.path):
        note(f"the dictionary was learnt for another system matrix than {system.path.name}")
    try:
        attrs = artefact.attrs["dictionary"]
        parameters = dict(attrs["parameters"])
        directions = parameters.get("directions")
        return Dictionary(
            atoms=atoms,
            synthesis=np.asarray(artefact.data.get("dictionary/synthesis", atoms), float),
            lam=float(attrs["lambda"]),
            sigma=float(parameters["sigma"]),
            directions=None if directions is None else int(directions),
            training=tuple(map(str, parameters.get("training", ()))),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise _nonsense(path, error) from None


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    """A dictionary as learning goes on with it.

    state: after the iterations done.
    settings: that it was learnt with.
    training: file names of the training pictures, sorted.
    """

    state: State
    settings: Settings
    training: tuple[str, ...]


def read_unfinished(path: Path, system: LensletMatrix, *, kept: bool) -> Unfinished:
    """What learning goes on from.

    path: of a dictionary artefact, or of a checkpoint.
    system: the matrix that it is learnt for.
    kept: only a checkpoint will do: it is written anew, and removed at the end.

    Raises InputError where it belongs to another system matrix, or lacks what a resumed run needs.
    """
    from plenocli.files.artefacts.provenance import file_digest
    from plenocli.files.artefacts.reading import read_artefact

    artefact = read_artefact(path, "checkpoint" if kept else ("dictionary", "checkpoint"))
    if artefact.provenance.inputs.get("pif", {}).get("sha256") != file_digest(system.path):
        raise InputError(
            f"was learnt for another system matrix than {system.path.name}",
            path,
            "give the pif it was learnt with",
        )
    prefix = "dictionary/state/"
    fields = {k.removeprefix(prefix): v for k, v in artefact.data.items() if k.startswith(prefix)}
    try:
        parameters = artefact.attrs["dictionary"]["parameters"]
        state = State.load(fields)
        if (
            not np.isfinite(state.atoms).all()
            or state.atoms.shape != artefact.data["dictionary/atoms"].shape
        ):
            raise ValueError("the atoms of its state are not those that it shows")
        if state.iteration != len(state.history):
            raise ValueError("its iterations and their history differ in number")
        return Unfinished(
            state=state,
            settings=Settings(**parameters["settings"]),
            training=tuple(parameters["training"]),
        )
    except KeyError as error:
        raise InputError(
            f"lacks {error}, which a resumed run needs", path, "start a new dictionary"
        ) from None
    except (TypeError, ValueError) as error:
        raise _nonsense(path, error) from None


def _nonsense(path: Path, error: Exception) -> InputError:
    return InputError(
        f"describes itself in a way that makes no sense ({error})", path, "make it again"
    )
