"""Tables of sweeps, into their artefact and out of it."""

from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.designs import DesignTable, Metric, Parameter

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance


def design_artefact(table: DesignTable, provenance: "Provenance") -> "Artefact":
    """The artefact of a table."""
    from plenocli.files.artefacts.container import Artefact

    attrs = {
        "chain": table.chain,
        "parameters": [parameter.as_json() for parameter in table.parameters],
        "metrics": [metric.as_json() for metric in table.metrics],
        "objectives": list(table.objectives.items()),
        "reasons": dict(table.reasons),
        "notes": dict(table.notes),
        "description": table.description,
    }
    data = {
        "sweep/parameter": table.values,
        "sweep/metric": table.figures if table.metrics else None,
        "sweep/status": table.status.astype(np.int32),
        "sweep/front": table.ahead,
        "sweep/key": table.keys,
    }
    return Artefact("sweep", data, {"sweep": attrs}, provenance)


def designs_of(artefact: "Artefact") -> DesignTable:
    """The table that an artefact of a sweep holds."""
    data, attrs = artefact.data, artefact.attrs["sweep"]
    status = data["sweep/status"]
    try:
        parameters = tuple(Parameter(**told) for told in attrs["parameters"])
        metrics = tuple(Metric(**told) for told in attrs["metrics"])
        objectives = dict(attrs["objectives"])
    except (KeyError, TypeError, ValueError) as error:
        what = f"a table of designs does not say what it holds ({type(error).__name__}: {error})"
        raise InputError(what, fix="make it again: plenocli sweep") from None
    return DesignTable(
        parameters=parameters,
        metrics=metrics,
        objectives=objectives,
        values=data["sweep/parameter"],
        figures=data.get("sweep/metric", np.zeros((len(status), 0))),
        status=status,
        ahead=data["sweep/front"].astype(bool),
        keys=data["sweep/key"],
        chain=attrs.get("chain", ""),
        reasons=attrs.get("reasons", {}),
        notes=attrs.get("notes", {}),
        description=attrs.get("description", {}),
    )
