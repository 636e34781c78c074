"""How far a long work has come, and how much longer it will take."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def bar() -> Iterator[Callable[..., None]]:
    """Show a bar with the stage, the share that is done and the times, on terminals only.

    What is yielded takes the stage and the share, None where it is not known.
    """
    from rich import progress as rich
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        # Progress(disable=True) of Rich before 14.3 writes an empty line at its end
        yield lambda *_: None
        return
    columns = (
        *(rich.SpinnerColumn(), rich.TextColumn("{task.description:<34}"), rich.BarColumn(28)),
        *(rich.TimeElapsedColumn(), rich.TimeRemainingColumn(compact=True), "left"),
    )
    with rich.Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task("", total=None)

        def say(stage: str, done: float | None = None) -> None:
            # without a total the bar pulses
            shown.tasks[0].total = None if done is None else 1.0
            shown.update(task, description=stage, completed=done or 0.0)

        yield say
