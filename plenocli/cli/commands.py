"""The commands and where each of them is."""

import importlib

import click

COMMANDS = {
    "init": "forward",
    "simulate-pif": "forward",
    "simulate-response": "forward",
    "capture-sim": "forward",
    "calibrate": "inverse",
    "demux": "inverse",
    "learn-dict": "inverse",
    "fit-camera": "inverse",
    "plan": "inverse",
    "reconstruct": "inverse",
    "refocus": "inverse",
    "volume": "inverse",
    "score": "evaluation",
    "report": "evaluation",
    "sweep": "sweep",
    "optimise": "sweep",
    "colorchecker": "evaluation",
    "show": "evaluation",
    "view": "evaluation",
    "inspect": "evaluation",
    "verify": "evaluation",
    "seal": "evaluation",
    "lens": "forward",
    "schema": "forward",
}
"""Name of a command -> folder of its file. The order is that of the pipeline, and of the help."""


def load_command(name: str) -> click.Command:
    """The click command `name`, imported when it is asked for."""
    return importlib.import_module(
        f"plenocli.cli.{COMMANDS[name]}.{name.replace('-', '_')}"
    ).command
