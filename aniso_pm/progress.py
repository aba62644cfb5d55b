"""A progress bar on the terminal or in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def bar(integrator, **options) -> Iterator[None]:
    """Show the progress of ``integrator`` (an ``aniso_pm``) while the block runs: passes, elapsed
    and remaining time, estimated error.

    options: of ``tqdm``. ::

        with aniso_pm.progress.bar(integrator):
            image = mi.render(scene, integrator=integrator)
    """
    from tqdm.auto import tqdm

    with tqdm(unit="pass", dynamic_ncols=True, **options) as shown:

        def show(done: float, total: int | None, text: str) -> None:
            # tqdm extrapolates from what was done since it began: earlier runs are not its own.
            if shown.n == 0 and done > 1:
                shown.initial = int(done)
            shown.total, shown.n = total, round(done, 2)
            shown.set_postfix_str(text)

        integrator.progress = show
        try:
            yield
        finally:
            integrator.progress = None
