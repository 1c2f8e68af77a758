"""What an extra of plenocli needs, as a command that installs it.

It works whichever way plenocli itself was installed.
"""

import re
from importlib.metadata import PackageNotFoundError, requires


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, by their own names and least versions.

    extra: a name of [project.optional-dependencies], such as "plot".

    Returns text such as "pip install 'matplotlib>=3.9'".
    The name plenocli is never in it: on an index it could be anybody's.
    """
    try:
        declared = requires("plenocli") or []
    except PackageNotFoundError:  # run from its sources
        declared = []
    parted = (line.partition(";") for line in declared)
    wanted = re.compile(rf"\bextra == ['\"]{re.escape(extra)}['\"]")
    found = [f"'{package.strip()}'" for package, _, marker in parted if wanted.search(marker)]
    if not found:
        return f"install what pyproject.toml lists as {extra}"
    return f"pip install {' '.join(found)}"
