"""What to type next, by what lies in a folder."""

from pathlib import Path

from plenocli.base.errors import InputError
from plenocli.files.outside import outside

MOST = 40
"""Files looked at."""


def next_step(folder: str | Path) -> str:
    """One sentence with a command, from the newest plenocli files in `folder`."""
    found = _kinds(Path(folder))
    cameras = sorted(p.name for p in Path(folder).glob("*.toml") if _is_camera(p))
    first = {kind: names[0] for kind, names in found.items()}
    if "image" in first and "capture" in first:
        return (
            f"plenocli score {' '.join(found['image'][:3])} --truth {first['capture']} -o "
            "score.json --report report.html"
        )
    if "spectra" in first:
        return f"plenocli show {first['spectra']} -o spectra.png"
    if "capture" in first and "pif" in first:
        return f"plenocli reconstruct {first['capture']} --pif {first['pif']} -o image.h5"
    if "capture" in first and "calibration" in first:
        return (
            f"plenocli demux {first['capture']} --calibration {first['calibration']} -o spectra.exr"
        )
    if "pif" in first and cameras:
        return (
            f"plenocli capture-sim {cameras[0]} --pif {first['pif']} --scene skimage:astronaut "
            "--snr 60dB -o capture.h5"
        )
    if "calibration" in first:
        return f"plenocli demux YOUR.nef --calibration {first['calibration']} -o spectra.exr"
    if cameras:
        several = f", or another of {len(cameras)} cameras here" if len(cameras) > 1 else ""
        return f"plenocli simulate-pif {cameras[-1]} -o pif.h5{several}"
    return (
        "plenocli init && make -C plenocli-start, which takes a sample camera through the chain; "
        "or describe yours (plenocli schema camera), or measure it (plenocli calibrate --help)"
    )


def _kinds(folder: Path) -> dict[str, list[str]]:
    """Kind -> names of artefacts in the folder, newest first; what cannot be read is left out."""
    found: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*.h5"), key=lambda p: (-p.stat().st_mtime, p.name))[:MOST]:
        try:
            kind = str(outside(_kind, path))
        except InputError:
            continue
        found.setdefault("pif" if kind == "pif-index" else kind, []).append(path.name)
    return found


def _kind(path: str) -> str:
    """What an artefact says that it is; runs outside."""
    import h5py

    with h5py.File(path, "r", locking=False) as file:
        kind: str = file.attrs["plenocli_kind"].decode()
        return kind


def _is_camera(path: Path) -> bool:
    try:
        return path.stat().st_size < 1 << 20 and "[lenslet_array]" in path.read_text(
            encoding="utf-8"
        )
    except (OSError, UnicodeDecodeError):
        return False
