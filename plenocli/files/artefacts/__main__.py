"""`python -m plenocli.files.artefacts`: every dataset of every kind of artefact, as
one Markdown page.
"""

from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.schema import markdown

print(markdown(SCHEMAS), end="")
