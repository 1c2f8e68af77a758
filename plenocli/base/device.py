"""Where large arrays are multiplied and transformed: by NumPy, or on a graphics card by PyTorch.
Kernels take their functions from their arrays, by the names of the array API standard.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.text import how_to_install


@dataclass(frozen=True)
class Device:
    """What arrays are put on.

    name: for people, None of the processor.
    xp: namespace of its arrays.
    place: what that calls it.
    """

    name: str | None = None
    xp: Any = np
    place: Any = None

    def put(self, array: np.ndarray) -> Any:
        """An array on it."""
        return array if self.xp is np else self.xp.asarray(array, device=self.place)

    def get(self, array: Any) -> np.ndarray:
        """An array of it, as NumPy's."""
        if self.place is not None:
            from array_api_compat import to_device

            array = to_device(array, "cpu")
        return np.asarray(array)


CPU = Device()
"""The processor."""


def device(name: str) -> Device:
    """The Device that --device names: "cpu", or "cuda", the graphics card that PyTorch takes.

    Raises UsageError where there is none.
    """
    if name == "cpu":
        return CPU
    try:
        import torch
        from array_api_compat import torch as xp
    except ImportError as error:
        raise UsageError(
            "a graphics card needs PyTorch, which is not installed",
            "--device",
            f"{how_to_install('gpu')}, or leave it out",
        ) from error
    if not torch.cuda.is_available():
        raise UsageError("PyTorch finds no graphics card", "--device", "leave it out")
    return Device(torch.cuda.get_device_name(), xp, "cuda")


def namespace(array: Any) -> Any:
    """The functions for an array."""
    if isinstance(array, np.ndarray):
        return np
    from array_api_compat import array_namespace

    return array_namespace(array)


def beside(array: Any, values: np.ndarray) -> Any:
    """Values of NumPy where an array is."""
    if isinstance(array, np.ndarray):
        return values
    from array_api_compat import device as place_of

    return namespace(array).asarray(values, device=place_of(array))
