"""`plenocli schema`: the JSON Schema of a configuration file."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from plenocli.base.progress import tell
from plenocli.cli import options

if TYPE_CHECKING:
    from pydantic import BaseModel


@click.command("schema", short_help="Print the JSON Schema of a camera, scene or lens description.")
@click.argument("kind", type=click.Choice(["camera", "microscope", "scene", "lens"]))
@options.mem_limit
def command(
    kind: str,
) -> None:
    """Print the JSON Schema of a configuration file, for editors and for checking without plenocli.

    \b
    Example:
      plenocli schema camera > camera.schema.json
    """
    from plenocli.files.config.lens_file import LensFile
    from plenocli.files.config.scene_file import Scene
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.camera.model import Camera

    models: dict[str, type[BaseModel]] = {
        "camera": Camera,
        "microscope": Microscope,
        "scene": Scene,
        "lens": LensFile,
    }
    tell(json.dumps(models[kind].model_json_schema(), indent=2))
