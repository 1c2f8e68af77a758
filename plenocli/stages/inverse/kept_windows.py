"""Volumes of windows, as numbers that a Bench keeps."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plenocli.files.bench import Bench
    from plenocli.inverse.volume.volume import Volume


def kept_part(bench: Bench, number: int, make: Callable[[], Volume]) -> Volume:
    """The volume of the window of a number: as an earlier run left it on the bench, else as it is
    made, which is left there.

    Raises OutputError where it cannot be.
    """
    found = bench.get(number)
    if found is not None:
        return _volume(found)
    volume = make()
    bench.put(number, _arrays(volume))
    return volume


def _arrays(volume: Volume) -> list[np.ndarray]:
    held = volume.held_out
    facts = {
        "type": volume.value.dtype.str,
        "method": volume.method,
        "trace": [[trial.what, trial.misfit] for trial in volume.trace],
        "background": volume.background,
        "margin": volume.margin,
        "prior": volume.prior and vars(volume.prior),
        "likeness": volume.likeness and vars(volume.likeness),
        "bars": volume.sigma is not None,
        "held": held and {name: values.dtype.str for name, values in vars(held).items()},
    }
    # of a text the numbers of its bytes: what is kept is numbers
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    arrays = [text, volume.value]
    arrays += [] if volume.sigma is None else [volume.sigma]
    return arrays + ([] if held is None else list(vars(held).values()))


def _volume(arrays: tuple[np.ndarray, ...]) -> Volume:
    from plenocli.inverse.volume.volume import HeldOut, Likeness, Prior, Trial, Volume

    text, value, *more = arrays
    facts = json.loads(text.astype(np.uint8).tobytes())
    kind = np.dtype(facts["type"])
    sigma = more.pop(0).astype(kind) if facts["bars"] else None
    held = None
    if facts["held"]:
        types = facts["held"].items()
        held = HeldOut(**{name: some.astype(own) for (name, own), some in zip(types, more)})
    return Volume(
        value=value.astype(kind),
        sigma=sigma,
        method=facts["method"],
        trace=tuple(Trial(what, misfit) for what, misfit in facts["trace"]),
        background=facts["background"],
        prior=facts["prior"] and Prior(**facts["prior"]),
        held_out=held,
        margin=facts["margin"],
        likeness=facts["likeness"] and Likeness(**facts["likeness"]),
    )
