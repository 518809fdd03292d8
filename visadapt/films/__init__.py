"""Films and plots of runs and results."""

from visadapt.films.filming import film

__all__ = ["film"]
