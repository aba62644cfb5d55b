"""A progress bar on the terminal or in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def bar(integrator, **options) -> Iterator[None]:
    """Show the progress of ``integrator`` (an ``aniso_pm``) while the block runs: passes, elapsed
    and remaining time, estimated error.

    options: of ``tqdm``. ::

        with aniso_pm.progress.bar(integrator):
            image = mi.render(scene, integrator=integrator)
    """
    with shown(unit="pass", **options) as show:
        integrator.progress = show
        try:
            yield
        finally:
            integrator.progress = None


@contextmanager
def shown(**options) -> Iterator[Callable[[float, float | None, str], None]]:
    """A bar that a function (done, total or None, text) sets. options: of ``tqdm``."""
    from tqdm.auto import tqdm

    with tqdm(dynamic_ncols=True, **options) as bar:

        def show(done: float, total: float | None, text: str) -> None:
            # tqdm extrapolates from what was done since it began: earlier runs are not its own.
            if bar.n == 0 and done > 1:
                bar.initial = int(done)
            bar.total, bar.n = total, round(done, 2)
            bar.set_postfix_str(text)

        yield show
