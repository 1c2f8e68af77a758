"""`plenocli schema`: the JSON Schema of a configuration file."""

import json

import click


@click.command("schema", short_help="Print the JSON Schema of a camera or scene description.")
@click.argument("kind", type=click.Choice(["camera", "scene"]))
def command(kind):
    """Print the JSON Schema of a configuration file, for editors and for checking without plenocli.

    \b
    Example:
      plenocli schema camera > camera.schema.json
    """
    from plenocli.config.camera import camera_schema
    from plenocli.config.scene import Scene

    click.echo(json.dumps(camera_schema() if kind == "camera" else Scene.model_json_schema(), indent=2))
