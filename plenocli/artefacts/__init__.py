"""Files in and out: the artefacts of all stages, EXR, camera RAW and DNG, photographs. Nothing heavy is imported until used."""

from importlib import import_module

_HOMES = {
    "Artefact": "container", "write_artefact": "container", "read_artefact": "container", "cfa_text": "container", "streamed_artefact": "stream",
    "writing_pif": "shards", "read_pif": "shards", "pif_parts": "shards", "shard_path": "shards",
    "default_mem_limit": "limits", "SCHEMAS": "kinds",
    "Provenance": "provenance", "describe_inputs": "provenance", "file_digest": "provenance", "provenance_texts": "provenance", "read_provenance_texts": "provenance",
    "require_file": "provenance",
    "check_output": "atomic", "publish": "atomic",
    "read_exr": "exr", "write_exr": "exr",
    "Spectral": "spectral_exr", "read_spectral_exr": "spectral_exr", "write_spectral_exr": "spectral_exr", "is_spectral": "spectral_exr",
    "Picture": "pictures", "read_picture": "pictures", "srgb_to_linear": "pictures",
    "Mosaic": "mosaic", "read_mosaic": "mosaic",
    "write_capture_exr": "mosaic", "write_dng": "dng", "read_raw": "raw",
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
