"""The points that a sweep file describes, each with the task that the chain makes of it."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.base.text import json_value
from plenocli.stages.sweep.task import (
    CHAINS,
    PointResult,
    Task,
    capture_key,
    digest_of,
    matrix_key,
    point_key,
    refused,
    task_of,
)

if TYPE_CHECKING:
    from plenocli.files.config.sweep_file import Choice, Range, Sweep
    from plenocli.forward.scene.labelled import LabelledSpectra
    from plenocli.stages.sweep.task import Description

ReadOptions = Callable[[str, Mapping[str, Any]], dict[str, Any]]

_FILES = ("aperture_image", "wavefront", "prescription")
"""Keys of the main lens that name files."""
_EXTERNAL = ("scene", "volume", "dictionary", "training", "classes", "prior")
"""Options that may name files, or folders of spectra."""


@dataclass(kw_only=True, eq=False)
class DesignPoint:
    """A point of the design space, and what came of it.

    number: its place in the table.
    values: by key, as they would stand in the sweep file.
    task: None where no such camera can be.
    key, matrix, capture: what point, matrix and a capture by another matrix are known by.
    result: None until it is there.
    """

    number: int
    values: Mapping[str, Any]
    task: Task | None = None
    key: str = ""
    matrix: str = ""
    capture: str = ""
    result: PointResult | None = None


@dataclass(kw_only=True)
class Space:
    """A sweep file with all that it names.

    path: of the file, `sweep` what it says, `axes` what varies freely.
    chain: of CHAINS.
    base: the camera it starts from, as its TOML says, from camera_path.
    read_options: (stage, values) -> option -> value, as the command line reads them.
    files: path -> SHA-256 of the files named so far.
    spectra: path -> labelled spectra of those that hold such.
    """

    path: Path
    sweep: Sweep
    axes: Mapping[str, Range | Choice]
    chain: str
    base: Mapping[str, Any]
    camera_path: Path
    read_options: ReadOptions
    seed: int
    files: dict[str, str] = field(default_factory=dict)
    spectra: dict[str, LabelledSpectra] = field(default_factory=dict)

    def point(self, number: int, values: Mapping[str, Any]) -> DesignPoint:
        """The point of these values; refused already where no such camera can be."""
        from plenocli.files.config.sweep_file import changed, options_of

        options = {
            stage: self.read_options(stage, self._located(given))
            for stage, given in options_of(self.sweep, values).items()
        }
        self._remember(options)
        self._check_spectra(options)
        try:
            camera = self._camera(
                changed(self.base, {**self.sweep.set, **values}, self.sweep.follow)
            )
        except ConfigError as error:
            known_by = {
                "refused": values,
                "options": json_value(options),
                "base": self.base,
                "chain": self.chain,
            }
            return DesignPoint(
                number=number,
                values=values,
                key=digest_of(known_by, self.files),
                result=refused(error),
            )
        task = task_of(self.chain, camera, json_value(options), self.seed)
        return DesignPoint(
            number=number,
            values=values,
            task=task,
            key=point_key(task, self.files),
            matrix=matrix_key(task, camera, self.files),
            capture=capture_key(task, self.files),
        )

    def _camera(self, data: dict[str, Any]) -> Description:
        from pydantic import ValidationError

        from plenocli.base.toml import violations
        from plenocli.forward.camera.microscope import Microscope
        from plenocli.forward.camera.model import Camera

        kind: type[Description] = Microscope if self.chain == "volume" else Camera

        lens = data.get("main_lens")
        if isinstance(lens, dict):
            for name in _FILES:
                if isinstance(lens.get(name), str):
                    lens[name] = self._digested((self.camera_path.parent / lens[name]).resolve())
        try:
            return kind.model_validate(data)
        except ValidationError as error:
            raise violations(error, "camera", kind) from None

    def _digested(self, path: Path) -> str:
        """The path as text; its content is known from now on."""
        from plenocli.files.artefacts.provenance import content_digest

        if str(path) not in self.files:
            self.files[str(path)] = content_digest(path)
        return str(path)

    def _located(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Options whose files, named relative to the sweep file, are found from anywhere."""

        def place(value: Any) -> Any:
            if isinstance(value, list):
                return [place(v) for v in value]
            known = isinstance(value, str) and (self.path.parent / value).exists()
            return str((self.path.parent / value).resolve()) if known else value

        return {
            name: place(value) if name in _EXTERNAL else value for name, value in values.items()
        }

    def _remember(self, options: Mapping[str, Mapping[str, Any]]) -> None:
        """Digest the files that options name."""
        for values in options.values():
            for name in _EXTERNAL:
                for value in np.ravel(values.get(name) or []):
                    if Path(str(value)).exists():
                        self._digested(Path(str(value)))

    def _check_spectra(self, options: Mapping[str, Mapping[str, Any]]) -> None:
        """Read the labelled spectra that options name, which every point would end without."""
        from plenocli.files.read.class_table import read_labelled, require_class

        for stage, name in (("score", "classes"), ("score", "prior"), ("demux", "prior")):
            table = options.get(stage, {}).get(name)
            if table is None:
                continue
            if str(table) not in self.spectra:
                self.spectra[str(table)] = read_labelled(table)
            if name == "classes":
                require_class(self.spectra[str(table)], options[stage].get("detect"), table)


def open_space(path: Path | str, read_options: ReadOptions, seed: int = 0) -> Space:
    """The Space of a sweep file.

    read_options: (stage, values) -> option -> value, as the command line reads them.
    seed: of captures and reconstructions.

    Raises InputError for files, ConfigError for what they say, UsageError for options.
    """
    from plenocli.files.config.camera_file import with_curves
    from plenocli.files.config.sweep_file import STAGES, load_sweep
    from plenocli.files.config.toml_file import read_text

    path = Path(path)
    sweep, axes = load_sweep(path)
    camera_path = path.parent / sweep.camera
    try:
        base = with_curves(tomllib.loads(read_text(camera_path, "camera")), camera_path.parent)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", camera_path, "mend the line") from None
    usual = "spectral" if "filter_array" in base else "spatial"
    microscope = "objective" in base
    chain = sweep.chain or ("volume" if microscope else usual)
    if (chain == "volume") != microscope:
        raise ConfigError(
            f"the camera has {'an' if microscope else 'no'} [objective]: chain {chain!r} is not "
            "one that it goes through",
            path,
            "leave chain out" if microscope else "name a microscope's description as camera",
        )
    named = [
        *sweep.options,
        *(head for key in [*sweep.varied, *sweep.set] if (head := key.partition(".")[0]) in STAGES),
    ]
    for stage in named:
        if stage not in CHAINS[chain]:
            raise ConfigError(
                f"{stage} is no stage of the {chain} chain ({', '.join(CHAINS[chain])})",
                path,
                f'leave it out, or set chain = "{_chain_with(stage)}"',
            )
    return Space(
        path=path,
        sweep=sweep,
        axes=axes,
        chain=chain,
        base=base,
        camera_path=camera_path,
        read_options=read_options,
        seed=seed,
    )


def _chain_with(stage: str) -> str:
    """The first chain that has a stage."""
    return next(chain for chain, stages in CHAINS.items() if stage in stages)
