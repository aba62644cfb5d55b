"""Error against run time: references, runs, metrics, plots and the page."""
