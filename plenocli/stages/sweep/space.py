"""The points that a sweep file describes, each with the task that the chain makes of it."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.base.text import plain
from plenocli.stages.sweep.point import CHAINS, matrix_key, point_key, refused, task_of

_FILES = ("aperture_image", "wavefront", "prescription")
"""Keys of the main lens that name files."""
_EXTERNAL = ("scene", "dictionary", "training")
"""Options that may name files."""


@dataclass
class Row:
    """A point: its number, values by key, task with its keys, and what came of it."""

    number: int
    point: dict
    task: dict | None = None
    key: str = ""
    matrix: str = ""
    camera: object = None
    result: dict | None = None


@dataclass
class Space:
    """A sweep file with all that it names: the description, its axes, the camera it starts from
    and how options are read.
    """

    path: Path
    sweep: object
    axes: dict
    chain: str
    base: dict
    camera_path: Path
    read_options: object
    seed: int
    files: dict = field(default_factory=dict)

    def row(self, number, point):
        """The Row of a point; refused already where no such camera can be."""
        from plenocli.files.config.sweep_file import changed, options_of

        options = {
            stage: self.read_options(stage, self._located(values))
            for stage, values in options_of(self.sweep, point).items()
        }
        self._remember(options)
        row = Row(number, point)
        try:
            row.camera = self._camera(
                changed(self.base, {**self.sweep.set, **point}, self.sweep.follow)
            )
        except ConfigError as error:
            row.result = refused(error)
            row.key = point_key(
                {
                    "refused": point,
                    "options": plain(options),
                    "base": self.base,
                    "chain": self.chain,
                },
                self.files,
            )
            return row
        row.task = task_of(self.chain, row.camera, plain(options), self.seed)
        row.key, row.matrix = (
            point_key(row.task, self.files),
            matrix_key(row.task, row.camera, self.files),
        )
        return row

    def _camera(self, data):
        from pydantic import ValidationError

        from plenocli.base.toml import violations
        from plenocli.forward.camera.model import Camera

        lens = data.get("main_lens")
        if isinstance(lens, dict):
            for name in _FILES:
                if isinstance(lens.get(name), str):
                    lens[name] = self._digested((self.camera_path.parent / lens[name]).resolve())
        try:
            return Camera.model_validate(data)
        except ValidationError as error:
            raise violations(error, "camera", Camera) from None

    def _digested(self, path):
        from plenocli.files.artefacts.provenance import file_digest

        if str(path) not in self.files:
            self.files[str(path)] = file_digest(path)
        return str(path)

    def _located(self, values):
        """Options whose files, named relative to the sweep file, are found from anywhere."""

        def place(value):
            if isinstance(value, list):
                return [place(v) for v in value]
            known = isinstance(value, str) and (self.path.parent / value).is_file()
            return str((self.path.parent / value).resolve()) if known else value

        return {
            name: place(value) if name in _EXTERNAL else value for name, value in values.items()
        }

    def _remember(self, options):
        for values in options.values():
            for name in _EXTERNAL:
                for value in np.ravel(values.get(name) or []):
                    if Path(str(value)).is_file():
                        self._digested(Path(str(value)))


def open_space(path, read_options, seed=0):
    """The Space of the sweep file at `path`.

    read_options(stage, values): option -> value of a stage as its command line reads them;
    UsageError. Errors: InputError for files, ConfigError for what they say.
    """
    from plenocli.files.config.sweep_file import STAGES, load_sweep
    from plenocli.files.config.toml_file import read_text

    path = Path(path)
    sweep, axes = load_sweep(path)
    camera_path = path.parent / sweep.camera
    try:
        base = tomllib.loads(read_text(camera_path, "camera"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", camera_path, "mend the line") from None
    chain = sweep.chain or ("spectral" if "filter_array" in base else "spatial")
    named = [
        *sweep.options,
        *(head for key in [*sweep.varied, *sweep.set] if (head := key.partition(".")[0]) in STAGES),
    ]
    for stage in named:
        if stage not in CHAINS[chain]:
            raise ConfigError(
                f"{stage} is no stage of the {chain} chain ({', '.join(CHAINS[chain])})",
                path,
                (
                    "leave it out, or set chain = "
                    f'"{"spatial" if chain == "spectral" else "spectral"}"'
                ),
            )
    return Space(path, sweep, axes, chain, base, camera_path, read_options, seed)
