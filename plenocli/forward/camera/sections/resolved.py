"""What a camera file may leave out and a camera always has."""

from typing import TYPE_CHECKING, Annotated, Any, TypeVar

if TYPE_CHECKING:
    _T = TypeVar("_T")
    Resolved = Annotated[_T, "may be left out of a file"]
else:

    class Resolved:
        """What a file may leave out or give in another way, and a Camera always has."""

        def __class_getitem__(cls, kind):
            return kind | None


LEFT_OUT: Any = None
