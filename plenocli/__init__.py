"""plenocli: an end-to-end model of plenoptic (light-field) cameras, as commands over files.

From Python, `import plenocli as pc` has the functions and types of plenocli.api, each imported when
it is first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plenocli.api import *  # noqa: F403

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    if name.startswith("_") or name == "api":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    api = importlib.import_module("plenocli.api")
    if name not in api.__all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *importlib.import_module("plenocli.api").__all__])
