"""Progress on stderr, only where a person watches, and notes that are always worth a line."""

import sys


def bar(iterable, total=None, label=""):
    """Wrap `iterable` so that a terminal shows how far it is and how long it will take; silent elsewhere."""
    from tqdm import tqdm

    return tqdm(iterable, total=total, desc=label, file=sys.stderr, disable=None, leave=False)


def note(text):
    """One line for the person who started the command: expectations, warnings, choices made."""
    print(f"plenocli: {text}", file=sys.stderr)
