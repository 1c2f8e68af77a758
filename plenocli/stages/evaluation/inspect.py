"""What a file holds, in words and numbers: every artefact, EXR, RAW, DNG, PNG, TIFF and JPEG."""

from pathlib import Path

import numpy as np


def run_inspect(path):
    """Read and verify the file at `path` and describe it as a JSON-able dict with "file", "bytes",
    "type" and what it holds.

    Raises InputError for a file that a stage would refuse, with the same words.
    """
    from plenocli.files.artefacts.provenance import require_file
    from plenocli.files.images.mosaic import is_hdf5
    from plenocli.files.images.pictures import file_type

    path = Path(path)
    report = {"file": path.name, "bytes": require_file(path)}
    kind = file_type(path)
    if is_hdf5(path):
        return report | _artefact(path)
    if kind == "exr":
        return report | _exr(path)
    if kind in ("png", "jpeg") or (kind == "tiff" and path.suffix.lower() in (".tif", ".tiff")):
        return report | _picture(path, kind)
    return report | _raw(path)


def _artefact(path):
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.artefacts.kinds import SCHEMAS

    artefact = read_artefact(path)
    schema, origin = SCHEMAS[artefact.kind], artefact.provenance
    datasets = {}
    for name, values in artefact.data.items():
        field = schema.field_for(name)
        datasets[name] = {
            "shape": list(values.shape),
            "dtype": str(values.dtype),
            "unit": field.unit,
            "meaning": field.doc,
        } | _statistics(values)
    attributes = {
        where: {
            name: {"value": _json(value), "unit": schema.attr_for(where, name).unit}
            for name, value in named.items()
        }
        for where, named in artefact.attrs.items()
        if named
    }
    return {
        "type": "artefact",
        "kind": artefact.kind,
        "schema_version": schema.version,
        "what": schema.doc,
        "verified": True,
        "command": origin.command,
        "seed": origin.seed,
        "inputs": origin.inputs,
        "accuracy": origin.accuracy,
        "config": origin.config,
        "datasets": datasets,
        "attributes": attributes,
    }


def _exr(path):
    from plenocli.files.images.exr import DIGEST, read_exr
    from plenocli.files.images.spectral_exr import is_spectral, read_spectral_exr

    channels, attrs = read_exr(path)
    rows, columns = next(iter(channels.values())).shape
    report = {
        "type": "exr",
        "rows": rows,
        "columns": columns,
        "verified": DIGEST in attrs,
        "channels": {name: _statistics(plane) for name, plane in channels.items()},
        "attributes": attrs,
    }
    if is_spectral(path):
        spectral = read_spectral_exr(path)
        report |= {
            "type": "spectral exr",
            "quantity": spectral.quantity,
            "wavelengths_m": [float(w) for w in spectral.wavelengths],
            "has_sigma": spectral.sigma is not None,
        }
    return report


def _picture(path, kind):
    from plenocli.files.images.pictures import read_stored

    values, names, bits = read_stored(path, kind)
    return {
        "type": kind,
        "rows": values.shape[0],
        "columns": values.shape[1],
        "bits": bits,
        "dtype": str(values.dtype),
        "verified": False,
        "channels": {name: _statistics(values[..., i]) for i, name in enumerate(names)},
    }


def _raw(path):
    from plenocli.files.images.mosaic import read_capture

    capture = read_capture(path)
    values, levels, meta = capture.mosaic, capture.levels, dict(capture.metadata.details)
    meta = {name: v for name, v in meta.items() if name not in ("make", "model") or not v}
    positions = {
        f"{letter} ({i}, {j})": _statistics(values[i::2, j::2])
        | {"black": float(levels.black[i, j])}
        for (i, j), letter in zip(
            [(0, 0), (0, 1), (1, 0), (1, 1)], "mmmm" if capture.cfa == "mono" else capture.cfa
        )
    }
    return {
        "type": "dng" if capture.metadata.source == "dng" else "raw",
        "rows": values.shape[0],
        "columns": values.shape[1],
        "cfa": capture.cfa,
        "black": levels.black.tolist(),
        "white": levels.white,
        "exposure_s": capture.exposure_s,
        "iso": meta.pop("iso", None),
        "f_number": meta.pop("f_number", None),
        "focal_length_m": meta.pop("focal_length_m", None),
        "camera": capture.metadata.camera,
        "dtype": str(values.dtype),
        "verified": bool(meta.pop("verified", False)),
        "zeros": float(np.mean(values == 0)),
        "saturated": float(np.mean(values >= levels.white)),
        "positions": positions,
        "meta": _json(meta),
    }


def _statistics(values):
    """Smallest, largest and mean value, and the number of NaN; nothing for text."""
    if values.dtype.kind not in "iufb" or values.size == 0:
        return {"value": _json(values)}
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values
    if known.size == 0:
        return {"nan": int(values.size)}
    out = {
        "min": float(known.min()),
        "max": float(known.max()),
        "mean": float(known.mean(dtype=np.float64)),
    }
    return out | ({"nan": int(values.size - known.size)} if known.size < values.size else {})


def _json(value):
    if isinstance(value, dict):
        return {str(k): _json(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_json(v) for v in value]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


# --- as text --------------------------------------------------------------------------------------


def describe(report):
    """The report of `run_inspect` as lines for a terminal."""
    lines = [f"{report['file']}: {_headline(report)}, {report['bytes']} bytes"]
    lines.append(
        "  digest verified"
        if report["verified"]
        else "  no digest in the file: damage to its values would go unseen"
    )
    return "\n".join(
        lines
        + {"artefact": _artefact_lines, "raw": _raw_lines, "dng": _raw_lines}.get(
            report["type"], _channel_lines
        )(report)
    )


def _headline(report):
    if report["type"] == "artefact":
        return (
            f"{report['kind']} (version {report['schema_version']}): {report['what'].rstrip('.')}"
        )
    return f"{report['type']}, {report['rows']} x {report['columns']} pixels (rows x columns)"


def _artefact_lines(report):
    lines = [
        f"  command   {report['command'] or '-'}",
        f"  seed      {'-' if report['seed'] is None else report['seed']}",
    ]
    lines += [
        f"  input     {role}: {entry['name']} sha256 {entry['sha256'][:16]}..."
        for role, entry in report["inputs"].items()
    ]
    lines += [f"  accuracy  {name}: {_short(value)}" for name, value in report["accuracy"].items()]
    lines += [
        f"  /{where} @{name} = {_short(entry['value'])} {entry['unit']}".rstrip()
        for where, named in report["attributes"].items()
        for name, entry in named.items()
    ]
    for name, entry in report["datasets"].items():
        shape = " x ".join(map(str, entry["shape"])) or "scalar"
        lines.append(
            f"  /{name}  {shape} {entry['dtype']} [{entry['unit']}]  "
            f"{_range(entry)}  {entry['meaning']}"
        )
    return lines


def _raw_lines(report):
    black = report["black"]
    unit = {"exposure_s": "s", "f_number": "", "focal_length_m": "m", "iso": ""}
    lines = [
        f"  camera         {report['camera'] or 'unknown'}",
        f"  cfa            {report['cfa']}",
        (
            f"  black          {black[0][0]:g} {black[0][1]:g} / {black[1][0]:g} {black[1][1]:g} "
            "DN (rows of the 2x2 cell)"
        ),
        f"  white          {report['white']:g} DN",
    ]
    lines += [
        (
            f"  {name:<14} "
            f"{'unknown' if report[name] is None else f'{report[name]:.6g} {label}'.rstrip()}"
        )
        for name, label in unit.items()
    ]
    lines.append(f"  zeros          {report['zeros']:.3%}, saturated {report['saturated']:.3%}")
    lines += [f"  {name:<14} {_range(entry)}" for name, entry in report["positions"].items()]
    return lines


def _channel_lines(report):
    lines = [f"  bits      {report['bits']}"] if "bits" in report else []
    if "wavelengths_m" in report:
        nm = [w * 1e9 for w in report["wavelengths_m"]]
        lines.append(
            f"  {report['quantity']}, {len(nm)} bands, {nm[0]:.6g} to {nm[-1]:.6g} "
            f"nm{', with sigma' if report['has_sigma'] else ''}"
        )
    lines += [f"  {name:<18} {_range(entry)}" for name, entry in report["channels"].items()]
    return lines + [
        f"  @{name} = {_short(value)}" for name, value in report.get("attributes", {}).items()
    ]


def _range(entry):
    if "min" not in entry:
        return "all NaN" if "nan" in entry else _short(entry["value"])
    return f"min {entry['min']:.6g} max {entry['max']:.6g} mean {entry['mean']:.6g}" + (
        f" NaN {entry['nan']}" if "nan" in entry else ""
    )


def _short(value):
    text = f"{value:.8g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 100 else text[:97] + "..."
