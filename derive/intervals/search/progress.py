"""A line on the terminal for searches that take longer than two seconds."""

import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rich.status import Status


_PATIENCE = 2.0


class Patience:
    """Shows what a long search is doing; silent before two seconds and off a terminal."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._status: Status | None = None
        self._silent = False

    def tell(self, text: str) -> None:
        """Show a line in place of the one before."""
        if self._silent or time.monotonic() - self._since < _PATIENCE:
            return
        if self._status is not None:
            self._status.update(text)
            return
        from rich.console import Console

        console = Console(stderr=True)
        if not console.is_terminal:
            self._silent = True
            return
        self._status = console.status(text)
        self._status.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._status is not None:
            self._status.stop()
