"""How far a long work has come, and how much longer it will take."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def bar() -> Iterator[Callable[..., None]]:
    """Show a bar with the stage, the share that is done and the times, on terminals only.

    What is yielded takes the stage and the share, None where it is not known.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        # Progress(disable=True) of Rich before 14.3 writes an empty line at its end
        yield lambda *_: None
        return
    columns = (SpinnerColumn(), TextColumn("{task.description:<34}"), BarColumn(28), _times())
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task("", total=None)

        def say(stage: str, done: float | None = None) -> None:
            # without a total the bar pulses
            shown.tasks[0].total = None if done is None else 1.0
            shown.update(task, description=stage, completed=done or 0.0)

        yield say


def times(elapsed: float, done: float | None) -> str:
    """Return the time that has passed, and what is left if it goes on like that."""
    told = _clock(elapsed)
    if done is None or done <= 0.0 or elapsed < 1.0:
        return told
    return f"{told}, {_clock(elapsed * (1.0 - done) / done)} left"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def _times() -> Any:
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

    class Times(ProgressColumn):
        def render(self, task: Task) -> Text:
            done = None if task.total is None else task.completed
            return Text(times(task.elapsed or 0.0, done))

    return Times()
