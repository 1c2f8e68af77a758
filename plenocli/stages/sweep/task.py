"""What is asked of one point of a sweep, and what came of it: types that pass through pools, and as
JSON through the journal.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from plenocli.base.text import Record

if TYPE_CHECKING:
    from plenocli.base.errors import PlenoError
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.camera.model import Camera

    Description = Camera | Microscope

Figure = Annotated[float, Field(ge=-1e100, le=1e100)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.]*$")]
Kept = TypeVar("Kept")

Options = Mapping[str, Any]
"""Option -> value of one stage, JSON-able."""

CHAINS = {
    "spatial": ("simulate-pif", "capture-sim", "reconstruct", "score"),
    "spectral": ("simulate-pif", "capture-sim", "simulate-response", "calibrate", "demux", "score"),
    "joint": (
        "simulate-pif",
        "capture-sim",
        "simulate-response",
        "calibrate",
        "demux",
        "reconstruct",
        "score",
    ),
    "expected": ("simulate-response", "demux", "score"),
    "depth": ("capture-sim", "refocus", "score"),
    "volume": ("simulate-pif", "capture-sim", "volume", "score"),
}
"""Stages of each chain, whose options may be set."""

OWN_MATRIX = {
    "refine",
    "bandwidth",
    "spectral_step",
    "superpixels",
    "coherent_ring",
    "accuracy",
    "model",
}
"""Options of capture-sim with which it computes a matrix of its own."""

DESIGN = {
    "electrons_per_pixel": (
        "photo-electrons that the first capture of the chain has in a pixel, mean over the sensor; "
        "where nothing is captured, those of the white reference, mean over a lenslet"
    ),
    "exposure_s": "exposure time of that capture, s",
    "class_rmse": "rmse over the chart of the classes",
    "class_spectral_angle_deg": "spectral_angle_deg over the chart of the classes",
    "class_delta_e_2000": "delta_e_2000 over the chart of the classes",
    "matrix_seconds": (
        "time to compute the system matrix on one core at nominal speed, as its plan counts it, s"
    ),
    "matrix_bytes": "size of the system matrix, bytes",
    "lenslets": "lenslets of the array",
    "sensor_pixels": "pixels of the sensor",
    "object_points": "object points over the whole array",
    "lenslet_field_m": (
        "width of one lenslet's field on the object: pitch times object distance "
        "over array distance, m"
    ),
}
"""Figures of every point beside those of score."""


@dataclass(frozen=True, kw_only=True)
class Task(Record):
    """One point, as everything that its figures depend on.

    chain: of CHAINS.
    camera: resolved description, TOML text.
    settings: stage -> its options.
    """

    chain: str
    camera: str
    settings: Mapping[str, Options]

    def options(self, stage: str) -> Options:
        """Those of one stage; empty where it has none."""
        return self.settings.get(stage, {})

    @property
    def foreign_capture(self) -> bool:
        """Whether another matrix makes the capture than inverts it."""
        if "capture-sim" not in CHAINS[self.chain]:
            return False
        return self.chain in ("depth", "volume") or bool(
            OWN_MATRIX & self.options("capture-sim").keys()
        )

    @property
    def needs_matrix(self) -> bool:
        """Whether something is captured, or inverted, with the matrix of simulate-pif."""
        if "simulate-pif" not in CHAINS[self.chain]:
            return False
        inverted = {"reconstruct", "volume"} & set(CHAINS[self.chain])
        return bool(inverted) or not self.foreign_capture

    @property
    def shown(self) -> dict[str, Options]:
        """What the chain captures, the first thing first: name -> options of capture-sim instead
        of those given; of a volume the capture and, in its place of one, what it shows.

        Where pictures and spectra are captured, --scene is the picture and --target has the
        spectra; classes that are to be told apart have a chart of their own.
        """
        given = self.options("capture-sim")
        if self.chain == "volume":
            return {"capture": {}, "truth": {}}
        if "demux" not in CHAINS[self.chain]:
            return {"capture": {}}
        picture = "reconstruct" in CHAINS[self.chain]
        found: dict[str, Options] = {"chart": {"scene": None} if picture else {}}
        found["white"] = {"scene": None, "target": "white"}
        if self.options("score").get("classes"):
            found["classes"] = {"scene": self.options("score")["classes"], "target": None}
        if picture:
            found["picture"] = {"scene": given.get("scene"), "target": None}
        return found


@dataclass(frozen=True, kw_only=True)
class MatrixCost:
    """What a system matrix costs, and what simulate-pif said.

    matrix_seconds: on one core at nominal speed, as planned.
    matrix_bytes: of its file.
    cpu_seconds: of the processor that it took, measured.
    """

    matrix_seconds: Figure = 0.0
    matrix_bytes: int = 0
    notes: tuple[str, ...] = ()
    cpu_seconds: Figure = 0.0


@dataclass(frozen=True)
class SharedMatrix:
    """A system matrix that lies there already: its file and its cost."""

    path: str
    cost: MatrixCost


@dataclass(frozen=True)
class MadeMatrix:
    """A system matrix as bytes of its artefact, and its cost."""

    content: bytes
    cost: MatrixCost


@dataclass(frozen=True)
class SharedCapture:
    """Captures that lie there already: their files, what was said of them, the seconds they
    took.
    """

    paths: tuple[str, ...]
    notes: tuple[str, ...] = ()
    cpu_seconds: float = 0.0


@dataclass(frozen=True)
class MadeCapture:
    """Captures as bytes of their artefacts, what was said of them, the seconds they took."""

    contents: tuple[bytes, ...]
    notes: tuple[str, ...]
    cpu_seconds: float


@dataclass(frozen=True, kw_only=True)
class Job:
    """A task with where it finds things.

    matrix: that points share, None where the point computes its own.
    capture: the same.
    files: what else is read.
    scratch: folder for files while the task lasts, None for the system's.
    """

    task: Task
    matrix: SharedMatrix | None = None
    capture: SharedCapture | None = None
    files: tuple[str, ...] = ()
    scratch: str | None = None


@dataclass(frozen=True, kw_only=True)
class PointResult:
    """What came of a point.

    status: exit code, 0 where all went well.
    reason: why a stage refused it.
    metrics: name -> figure; empty for a refused one.
    notes: what the stages said.
    seconds: of the processor, for all that was done for this point alone.
    stages: seconds of the processor of each stage, measured; of what is shared, those it took.
    """

    status: int = 0
    reason: str = ""
    metrics: Mapping[Name, Figure | None] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: Figure = 0.0
    stages: Mapping[str, Figure] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class KeptCapture:
    """What the journal keeps of a capture: how many files it is, what was said, seconds."""

    files: Annotated[int, Field(ge=1, le=100)]
    notes: tuple[str, ...] = ()
    cpu_seconds: float = 0.0


def remembered(kind: type[Kept], record: Any) -> Kept | None:
    """The `kind` that a journal keeps as `record`; None where it is none, for then it was written
    by hand or by another version, and is worked out anew.
    """
    try:
        return TypeAdapter(kind).validate_python(record)
    except ValidationError:
        return None


def refused(error: PlenoError) -> PointResult:
    """The result of a point that a stage refused."""
    return PointResult(status=error.exit_code, reason=str(error))


def task_of(chain: str, camera: Description, options: Mapping[str, Options], seed: int) -> Task:
    """The task of one point, with what the chain supposes.

    options: stage -> options as the command line reads them, only those given.
    seed: of captures and reconstructions, where none is given.
    """
    from plenocli.files.config.microscope_file import description_toml

    spectra = "demux" in CHAINS[chain]
    capture: dict[str, Any] = {"seed": seed}
    if chain == "volume":
        # finer than it is inverted
        capture |= {"volume": "phantom:beads", "refine": 2}
    elif chain == "joint":
        capture |= {"target": "colorchecker", "scene": "skimage:astronaut"}
    elif not options.get("capture-sim", {}).keys() & {"scene", "target"}:
        capture |= {"target": "colorchecker"} if spectra else {"scene": "skimage:astronaut"}
    banded = spectra and "wavelengths" not in options.get("simulate-pif", {})
    supposed: dict[str, Options] = {
        "capture-sim": capture,
        "simulate-pif": {"spectral_step": "auto"} if banded else {},
        # auto would try several methods at every point
        "reconstruct": {"method": "lmmse", "seed": seed},
        "volume": {"method": "rl", "seed": seed},
    }
    settings = {
        stage: {**supposed.get(stage, {}), **options.get(stage, {})}
        for stage in CHAINS[chain]
        if stage != "calibrate" or stage in options
    }
    return Task(chain=chain, camera=description_toml(camera), settings=settings)


def point_key(task: Task, files: Mapping[str, str]) -> str:
    """What a point is known by: SHA-256 of everything that its figures depend on.

    files: path -> SHA-256 of the files it names.
    """
    return digest_of(task.as_json(), files)


def capture_key(task: Task, files: Mapping[str, str]) -> str:
    """What the capture of a point is known by, where another matrix makes it than inverts it:
    points that differ only in how they invert share it. "" where the point's own matrix makes it.

    files: path -> SHA-256 of the files it names.
    """
    options = task.options("capture-sim")
    asked = {"shown": task.shown, "camera": task.camera, "capture": options}
    return digest_of(asked, files) if task.foreign_capture else ""


def matrix_key(task: Task, camera: Description, files: Mapping[str, str]) -> str:
    """What the matrix of a point is known by: of the camera only what A depends on, so that points
    share it. "" where the chain needs none.

    files: path -> SHA-256 of the files it names.
    """
    from plenocli.forward.camera.sections.light import Light
    from plenocli.forward.camera.sections.sensor import Sensor

    if not task.needs_matrix:
        return ""
    settings = task.options("simulate-pif")
    kept = camera.model_dump(mode="json")
    # without an accuracy asked for, the sensor's noise decides how exact the matrix is
    noise = set() if settings.get("accuracy") is not None else {"full_well", "read_noise"}
    colour = {"cfa"} if "demux" in CHAINS[task.chain] else set()
    for section, names in (
        ("lenslet_array", {"count"}),
        ("light", {"illuminant", "white_exposure", *Light.STRENGTHS}),
        ("sensor", Sensor.DETECTION - colour - noise),
    ):
        kept[section] = {name: value for name, value in kept[section].items() if name not in names}
    return digest_of({"camera": kept, "settings": settings}, files)


def digest_of(value: Any, files: Mapping[str, str]) -> str:
    """SHA-256 of the version and of a JSON-able value, with paths of `files` (path -> digest)
    standing as what they hold.
    """
    from plenocli import __version__

    def content(part: Any) -> Any:
        """`part` with every path in its strings replaced by what the file holds."""
        if isinstance(part, dict):
            return {key: content(inner) for key, inner in part.items()}
        if isinstance(part, (list, tuple)):
            return [content(inner) for inner in part]
        if isinstance(part, str):
            for path, digest in files.items():
                part = part.replace(path, f"sha256 {digest}")
        return part

    return hashlib.sha256(
        json.dumps([__version__, content(value)], sort_keys=True).encode()
    ).hexdigest()
